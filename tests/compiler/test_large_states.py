"""Many states on arrays, the form of functions that are too large to write out.

The limit is lowered, so that a dozen states are many.
"""

import warnings

import numpy as np
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.codegen import functions as lowering
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihood, LogLikelihoodGradient
from pymc_statespace_filters.ops.signatures import POINTS
from pymc_statespace_filters.testing import kalman_log_likelihood

N_STATES = 12
STEPS = [0, 2, 5]
A = 0.9 * np.eye(N_STATES) + 0.05 * np.roll(np.eye(N_STATES), 1, axis=1)
C = np.eye(N_STATES)[::4]
Q, R = 0.1 * np.eye(N_STATES), 0.2 * np.eye(3)
DECAY = 0.95
N_LORENZ = 60


@pytest.fixture(autouse=True)
def on_arrays(monkeypatch):
    monkeypatch.setattr(lowering, "MAX_EXPRESSIONS", 400)


@pytest.fixture(scope="module")
def chain():
    """A ring of states, each drawn to its neighbour; every fourth is seen."""
    return psf.StateSpaceModel(
        transition=lambda x, q, decay: decay * (A @ x) + q,
        process_noise=Q,
        observation=lambda x: C @ x,
        observation_noise=R,
        initial_mean=np.zeros(N_STATES),
        initial_cov=np.eye(N_STATES),
    )


@pytest.fixture(scope="module")
def record():
    observed = np.random.default_rng(40).normal(scale=1.2, size=(len(STEPS), 3))
    observed[1, 2] = np.nan
    return observed


def kalman(record, decay=DECAY):
    zero, one = np.zeros(N_STATES), np.eye(N_STATES)
    return kalman_log_likelihood(decay * A, Q, C, R, zero, one, steps=STEPS, observed=record)


def test_ekf_is_the_kalman_filter_at_every_point_of_a_batch(chain, record):
    """Too many states to write out are evaluated in turn; a point that fails touches no other."""
    points = np.array([[DECAY], [np.nan], [0.7]])
    batch = evaluator(LogLikelihood(chain, psf.EKF(), POINTS))
    terms, health = batch(
        points, np.array(STEPS), record, np.zeros((0, 0)), np.array(0.0), np.array(0)
    )
    for i in (0, 2):
        np.testing.assert_allclose(terms[i], kalman(record, points[i, 0]), rtol=1e-9)
        np.testing.assert_array_equal(health[i], [np.inf, 0, -1])
    # The first observation is of the start, which does not depend on the parameter.
    np.testing.assert_array_equal(terms[1], [terms[0, 0], -np.inf, -np.inf])
    assert health[1, 1] != 0
    assert health[1, 2] == 1


def test_enkf_approaches_the_kalman_filter(chain, record):
    # The Gaussian form estimates 3 means and a covariance of 3 from 2000 members: its spread over
    # the seeds is measured, its bias is of the order of p^2 / N = 0.005.
    terms = psf.log_likelihood(
        chain, psf.EnKF(2000, likelihood="gaussian"), {"decay": DECAY}, record, steps=STEPS,
        seed=np.arange(12),
    )  # fmt: skip
    error = terms.sum(axis=1) - kalman(record).sum()
    standard_error = error.std(ddof=1) / np.sqrt(error.size)
    assert abs(error.mean()) < 4 * standard_error + 0.02
    assert standard_error < 0.1


@pytest.mark.slow
def test_ekf_gradient_is_the_slope_of_the_kalman_filter(chain, record):
    gradient = evaluator(LogLikelihoodGradient(chain, psf.EKF()))
    (slope,) = gradient(
        np.array([DECAY]), np.array(STEPS), record, np.zeros((0, 0)), np.array(0.0), np.array(0),
        np.ones(len(STEPS)),
    )  # fmt: skip
    h = 1e-5
    difference = (kalman(record, DECAY + h) - kalman(record, DECAY - h)).sum() / (2 * h)
    assert slope == pytest.approx(difference, rel=1e-6)


def lorenz_drift(x, forcing=8.0):
    """Lorenz 1996."""
    return (pt.roll(x, -1) - pt.roll(x, 2)) * pt.roll(x, 1) - x + forcing


@pytest.fixture(scope="module")
def lorenz():
    return psf.StateSpaceModel(
        transition=psf.EulerMaruyama(lorenz_drift, 0.5 * np.eye(N_LORENZ), dt=0.01),
        observation=lambda x: x[::2],
        observation_noise=0.5 * np.eye(N_LORENZ // 2),
        initial_mean=8.0 + np.sin(np.arange(N_LORENZ)),
        initial_cov=np.eye(N_LORENZ),
    )


@pytest.mark.slow
def test_lorenz_96_is_simulated_as_written(lorenz):
    path = psf.simulate(lorenz, {}, steps=[0, 50], random_seed=3).states.values
    x = path[:-1]
    drift = (np.roll(x, -1, 1) - np.roll(x, 2, 1)) * np.roll(x, 1, 1) - x + 8.0
    noise = (path[1:] - x - 0.01 * drift) / (0.5 * np.sqrt(0.01))
    # 3000 standard normals: the mean square within 5 standard errors of 1.
    assert abs((noise**2).mean() - 1) < 5 * np.sqrt(2 / noise.size)
    assert abs(noise.mean()) < 5 / np.sqrt(noise.size)


@pytest.mark.slow
def test_lorenz_96_runs_and_particle_filters_warn_of_collapse(lorenz):
    steps = [5, 10, 15]
    record = psf.simulate(lorenz, {}, steps=steps, random_seed=4).observations.values
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gaussian = psf.EnKF(100, likelihood="gaussian")
        assert np.isfinite(psf.log_likelihood(lorenz, gaussian, {}, record, steps=steps)).all()
    for filter in (psf.BootstrapPF(100), psf.PFEnKF(100)):
        with pytest.warns(psf.errors.FilterWarning, match="fewer than 3 particles"):
            terms = psf.log_likelihood(lorenz, filter, {}, record, steps=steps)
        assert not np.isnan(terms).any()
