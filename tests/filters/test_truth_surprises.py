"""A precise sensor and three surprises: estimates collapse, and the package says so once."""

import re
import warnings

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from tests.references.records import PRECISE_DOUBLE_WELL, SURPRISES, double_well_with_surprises
from tests.systems import DOUBLE_WELL_SYSTEM, double_well_parameters


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
    assert [w.category for w in caught] == [psf.errors.FilterWarning]
    message = str(caught[0].message)
    assert np.isfinite(terms).all()

    error = terms - truth
    assert (error.sum(axis=-1) < -20.0).all()  # measured: -65, standard deviation 11
    assert error.sum(axis=-1).std(ddof=1) > 3.0  # another answer for every seed
    at_surprises = sum(error[:, j] + error[:, j + 1] for j in SURPRISES)
    elsewhere = error.sum(axis=-1) - at_surprises
    assert (at_surprises < -20.0).all()
    assert (elsewhere > -20.0).all()

    # The warning tells of the seed whose particles were the fewest.
    said = re.search(r"these are (\d+) of 1000 terms, j = (.*), together (\S+) nats", message)
    n_few, listed = int(said[1]), [int(j) for j in said[2].removesuffix(", ..").split(", ")]
    assert len(listed) == min(n_few, 8)
    assert set(SURPRISES) <= set(listed)
    below = float(re.search(r"the log-likelihood is (\S+) nats below", message)[1])
    worst = np.flatnonzero(np.abs(error.sum(axis=-1) + below) < 0.06)
    assert worst.size == 1
    if n_few == len(listed):
        assert error[worst[0], listed].sum() == pytest.approx(-float(said[3]), abs=0.06)
    assert message.endswith("Use GridFilter(), which computes this likelihood without particles.")


def test_the_remedy_where_no_exact_filter_is():
    """Two states, counts: the filters that need Gaussian noise are no remedy."""
    system = psf.StateSpaceModel(
        transition=lambda x, q: [0.9 * x[0] + q[0], 0.5 * x[1] + q[1]],
        process_noise=[[0.1, 0.0], [0.0, 0.1]],
        observation_dist=lambda x: [pm.Poisson.dist(mu=pt.exp(x[0] + x[1]))],
        initial_mean=[0.0, 0.0],
        initial_cov=[[0.1, 0.0], [0.0, 0.1]],
    )
    with pytest.warns(
        psf.errors.FilterWarning, match="these are 1 of 2 terms, j = 1; at 5 seeds"
    ) as caught:
        psf.log_likelihood(system, psf.BootstrapPF(30), {}, [1.0, 60.0], steps=[0, 1])
    (message,) = (str(w.message) for w in caught)
    assert "Use GuidedPF(100)" in message
    assert not re.search(r"GridFilter|\bEKF|EnKF", message)
