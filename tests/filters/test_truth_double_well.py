"""What each filter gets wrong on the double well, measured against the point-mass filter.

The record crosses the barrier once, after an excursion that no Gaussian update follows.
"""

from functools import cache

import numpy as np
import pytest

import pymc_statespace_filters as psf
from tests.references.records import (
    DOUBLE_WELL,
    double_well,
)
from tests.systems import DOUBLE_WELL_SYSTEM, double_well_parameters, log_likelihoods


@cache
def true_terms():
    return DOUBLE_WELL.point_mass_filter().run(*double_well()).terms


def of_double_well(filter, reference, record, n_seeds):
    """Total log-likelihoods (n_seeds,) from the package."""
    params, seeds = double_well_parameters(reference), np.arange(n_seeds)
    return log_likelihoods(DOUBLE_WELL_SYSTEM, filter, params, seeds, **record._asdict())


def assert_mean(sample, expected, expected_se=0.0):
    """Within four standard errors: a right answer fails once in 16 000 (the seeds are fixed)."""
    standard_error = np.hypot(sample.std(ddof=1) / np.sqrt(len(sample)), expected_se)
    assert abs(sample.mean() - expected) < 4.0 * standard_error


def test_ekf_loses_eighteen_nats_at_the_crossing():
    record = double_well()
    terms = psf.log_likelihood(
        DOUBLE_WELL_SYSTEM,
        psf.EKF(),
        double_well_parameters(DOUBLE_WELL),
        record.observed,
        steps=record.steps,
    )
    error = terms - true_terms()
    assert error.sum() == pytest.approx(-18.1475, abs=1e-3)
    crossing = int(np.flatnonzero(np.diff(np.sign(record.observed)))[0])
    assert error[crossing + 1 : crossing + 4].sum() < -17.0


# Bias and its standard error, from the independent filters of tests/references/faulty_filters.py.
@pytest.mark.parametrize(
    ("filter", "n_seeds", "bias", "bias_se"),
    [
        (psf.EnKF(1000), 100, -6.02, 0.09),
        pytest.param(psf.PFEnKF(500), 40, -2.69, 0.34, marks=pytest.mark.slow),
        pytest.param(
            psf.PFEnKF(500, likelihood="weights"), 40, -3.02, 0.31, marks=pytest.mark.slow
        ),
    ],
    ids=["enkf", "pf_enkf", "pf_enkf_weights"],
)
def test_bias_is_that_of_the_algorithm(filter, n_seeds, bias, bias_se):
    truth = true_terms().sum()
    error = of_double_well(filter, DOUBLE_WELL, double_well(), n_seeds) - truth
    assert_mean(error, bias, bias_se)


def test_bootstrap_likelihood_has_the_right_mean():
    truth = true_terms().sum()
    error = of_double_well(psf.BootstrapPF(1000), DOUBLE_WELL, double_well(), 400) - truth
    assert error.var() < 2.5
    assert_mean(np.exp(error), 1.0)
