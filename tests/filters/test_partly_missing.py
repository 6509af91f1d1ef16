"""Rows of `observation_dist` of which a part is missing: the components that are there count."""

import numpy as np
import pymc as pm
import pytest
from scipy import stats

import pymc_statespace_filters as psf
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.diagnostics.test_innovations import diagnosed
from tests.references.linear_states import linear_states

pytestmark = pytest.mark.usefixtures("interpreted")

A, Q, C, R, M0, P0 = 0.9, 0.2, [[1.0], [2.0]], np.diag([0.5**2, 1.5**2]), 0.3, 0.8
# Exact by Kalman's formulas, but the package knows distributions alone.
NORMAL = psf.StateSpaceModel(
    transition=lambda x, q, a: [a * x[0] + q[0]],
    process_noise=[[Q]],
    observation_dist=lambda x: [
        pm.Normal.dist(mu=x[0], sigma=0.5),
        pm.Normal.dist(mu=2.0 * x[0], sigma=1.5),
    ],
    initial_mean=[M0],
    initial_cov=[[P0]],
)
STEPS = np.array([0, 2, 3, 5])
DATA = np.array([[0.1, 0.4], [0.9, np.nan], [np.nan, np.nan], [np.nan, 1.6]])
TERMS = kalman_log_likelihood(
    [[A]], [[Q]], C, R, [M0], [[P0]], observed=DATA, steps=STEPS
)  # fmt: skip


def states(moment):
    return linear_states(
        A, Q, C, R, [M0], P0, steps=STEPS, observed=DATA, rows=STEPS, moment=moment
    )


@pytest.mark.parametrize(
    ("filter", "tolerance"),
    [
        (psf.IPLF(), 1e-11),
        (psf.GridFilter(), 1e-5),
        (psf.GuidedPF(2000), 0.01),
        (psf.BootstrapPF(20_000), 0.05),
    ],
    ids=lambda value: type(value).__name__,
)
def test_terms_and_states_are_those_of_kalman(filter, tolerance):
    """Tolerances of the particle filters are four of their standard deviations, over seeds."""
    settings = dict(steps=STEPS)
    terms = psf.log_likelihood(NORMAL, filter, {"a": A}, DATA, **settings)
    np.testing.assert_allclose(terms, TERMS, rtol=0, atol=tolerance)
    if isinstance(filter, psf.GuidedPF):
        return
    run = psf.run_filter(NORMAL, filter, {"a": A}, DATA, **settings)
    exact = states("filtered")
    np.testing.assert_allclose(run["mean"], exact.mean, rtol=0, atol=tolerance)
    np.testing.assert_allclose(run["sd"], exact.sd, rtol=0, atol=tolerance)


def test_records_of_a_panel_are_those_alone():
    rows = {"steps": np.tile(STEPS, 2), "panel": np.repeat([0, 1], STEPS.size)}
    terms = psf.log_likelihood(
        NORMAL, psf.BootstrapPF(20_000), {"a": A}, np.concatenate([DATA, DATA]), **rows
    )
    np.testing.assert_allclose(terms, np.tile(TERMS, 2), rtol=0, atol=0.05)


def test_predictions_of_the_component_that_is_there_are_scored():
    """They are draws of distributions: to five standard errors of their mean."""
    found = diagnosed(NORMAL, psf.BootstrapPF(500), DATA, STEPS, 200, a=A)
    exact = states("predicted")
    mean = exact.mean @ np.transpose(C)
    sd = np.sqrt(exact.sd**2 @ np.square(np.transpose(C)) + np.diagonal(R))
    off = (found["d_innovation"] - (DATA - mean)) / (sd / np.sqrt(200))
    np.testing.assert_array_equal(np.isnan(off), np.isnan(DATA))
    assert np.nanmax(np.abs(off)) < 5.0
    np.testing.assert_array_equal(np.isnan(found["d_residual"]), np.isnan(DATA))


def test_a_partly_missing_row_ends_a_sum_that_it_has_or_that_counts_rows():
    """By hand, without noise: the sum is missing in the first row."""
    system = dict(
        transition=lambda x: [x[0], x[1] + x[0]],
        observation_dist=lambda x: [
            pm.Normal.dist(mu=x[0], sigma=1.0),
            pm.Normal.dist(mu=x[1], sigma=1.0),
        ],
        initial_mean=[2.0, 0.0],
        initial_cov=[[0.0, 0.0], [0.0, 0.0]],
        accumulators=["x1"],
    )
    observed = np.array([[2.5, np.nan], [np.nan, 9.0]])
    for resets, n_steps in ((None, 5), ("seen", 5), ("row", 2)):
        own = psf.StateSpaceModel(**system, resets=resets)
        terms = psf.log_likelihood(own, psf.EKF(), {}, observed, steps=[3, 5])
        expected = [stats.norm.logpdf(2.5, 2.0), stats.norm.logpdf(9.0, n_steps * 2.0)]
        np.testing.assert_allclose(terms, expected, rtol=1e-12)
