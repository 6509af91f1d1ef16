"""A precise sensor and three surprises: estimates collapse, and the package says so once."""

import warnings

import numpy as np

import pymc_statespace_filters as psf
from tests.filters.truth_systems import DOUBLE_WELL_SYSTEM, double_well_parameters
from tests.references.records import PRECISE_DOUBLE_WELL, SURPRISES, double_well_with_surprises


def test_bootstrap_filter_falls_far_below_the_truth_and_warns_once():
    record = double_well_with_surprises()
    truth = PRECISE_DOUBLE_WELL.point_mass_filter().run(*record).terms
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        terms = psf.log_likelihood(
            DOUBLE_WELL_SYSTEM,
            psf.BootstrapPF(1000),
            double_well_parameters(PRECISE_DOUBLE_WELL),
            record.observed,
            steps=record.steps,
            seed=np.arange(6),
        )
    assert [w.category for w in caught] == [psf.FilterWarning]
    assert np.isfinite(terms).all()

    error = terms - truth
    assert (error.sum(axis=-1) < -20.0).all()  # measured: -65, standard deviation 11
    assert error.sum(axis=-1).std(ddof=1) > 3.0  # another answer for every seed
    at_surprises = sum(error[:, j] + error[:, j + 1] for j in SURPRISES)
    elsewhere = error.sum(axis=-1) - at_surprises
    assert (at_surprises < -20.0).all()
    assert (elsewhere > -20.0).all()
