"""Sensors whose noise is known for each observation, or that have none."""

import numpy as np
import pytest
from scipy.linalg import solve_triangular

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.references.linear_states import _all_steps
from tests.systems import forced, forced_terms

pytestmark = pytest.mark.usefixtures("interpreted")

A, Q, P0 = 0.8, 1.0, 1.0
STEPS = np.array([0, 2, 3, 7])
DATA = np.array([0.4, -1.2, np.nan, 0.9])
ERRORS = np.array([0.3, 9.0, 0.1, 9.0, 9.0, 9.0, 9.0, 2.0])  # of the steps 0 to 7
# The covariance of a sensor that drifts, and has an error bar for each observation.
SYSTEM = forced(
    transition=lambda x, q, a: [a * x[0] + q[0]],
    observation_noise=lambda u, t, s: [[u[0] ** 2 + s * t]],
    inputs=["error"],
)
PARAMS = {"a": A, "s": 0.2}
RECORD = {"steps": STEPS, "inputs": ERRORS}


def exact_terms():
    """By the dense Gaussian law of all observations."""
    rows = ~np.isnan(DATA)
    at = STEPS[rows]
    mean, cov = _all_steps(np.array([[A]]), np.array([[Q]]), [0.0], [[P0]], at[-1] + 1, None)
    noise = ERRORS[at] ** 2 + 0.2 * at
    root = np.linalg.cholesky(cov[:, 0, :, 0][np.ix_(at, at)] + np.diag(noise))
    z = solve_triangular(root, DATA[rows] - mean[at, 0], lower=True)
    terms = np.zeros(DATA.size)
    terms[rows] = -0.5 * z**2 - np.log(root.diagonal()) - 0.5 * np.log(2 * np.pi)
    return terms


TERMS = exact_terms()


@pytest.mark.parametrize(
    ("filter", "tolerance"),
    [
        (psf.EKF(), 1e-12),
        (psf.IPLF(), 1e-10),
        (psf.GridFilter(), 1e-5),
        (psf.GuidedPF(200), 1e-10),
        (psf.BootstrapPF(20_000), 0.08),
        (psf.EnKF(20_000), 0.08),
    ],
    ids=lambda value: type(value).__name__,
)
def test_an_error_bar_for_each_observation(filter, tolerance):
    """Tolerances of estimates are four of their standard deviations, over seeds.

    On a linear system the sum of the terms of a guided filter is exact.
    """
    terms = psf.log_likelihood(SYSTEM, filter, PARAMS, DATA, **RECORD)
    if isinstance(filter, psf.GuidedPF):
        assert terms.sum() == pytest.approx(TERMS.sum(), abs=tolerance)
        return
    np.testing.assert_allclose(terms, TERMS, rtol=0, atol=tolerance)


def test_records_of_a_panel_have_their_own_error_bars():
    rows = {"steps": np.tile(STEPS, 2), "panel": np.repeat(["A", "B"], STEPS.size)}
    other = np.ones_like(ERRORS)
    terms = psf.log_likelihood(
        SYSTEM, psf.EKF(), PARAMS, np.tile(DATA, 2), **rows, inputs={"A": ERRORS, "B": other}
    )
    alone = psf.log_likelihood(SYSTEM, psf.EKF(), PARAMS, DATA, steps=STEPS, inputs=other)
    np.testing.assert_allclose(terms, [*TERMS, *alone], rtol=0, atol=1e-12)


def test_simulations_have_the_noise_of_their_time():
    """Standard deviations of 400 draws, to five standard errors."""
    steps, n = np.arange(8), 400
    rows = {"steps": np.tile(steps, n), "panel": np.repeat(np.arange(n), 8)}
    drawn = psf.simulate(SYSTEM, PARAMS, **rows, inputs=ERRORS, random_seed=1)
    states = drawn["states"].values.reshape(n, 8)
    noise = drawn["observations"].values.reshape(n, 8) - states
    sd = np.sqrt(ERRORS**2 + 0.2 * steps)
    np.testing.assert_allclose(noise.std(axis=0), sd, rtol=5.0 / np.sqrt(2 * n))


def test_noise_may_not_depend_on_the_state():
    with pytest.raises(ModelError, match=r"observation_noise: .*'x' is reserved .* may have u, t"):
        forced(observation_noise=lambda x: [[x[0] ** 2]])


# Sensors without noise.

EXACT = [
    forced(transition=lambda x, q, a: [a * x[0] + q[0]], inputs=(), observation_noise=noise)
    for noise in ([[0.0]], lambda: [[0.0]])
]


@pytest.mark.parametrize("system", EXACT, ids=["numbers", "function"])
def test_a_sensor_without_noise_is_exact_in_kalman_filters(system):
    expected = forced_terms(A, DATA, STEPS, np.zeros(8), observation_noise=0.0)
    for filter in (psf.EKF(), psf.UKF()):
        terms = psf.log_likelihood(system, filter, {"a": A}, DATA, steps=STEPS)
        np.testing.assert_allclose(terms, expected, rtol=1e-12, atol=1e-14)
    run = psf.run_filter(system, psf.EKF(), {"a": A}, DATA, steps=STEPS)
    np.testing.assert_allclose(run["mean"].values[[0, 1, 3], 0], DATA[[0, 1, 3]], rtol=1e-12)


@pytest.mark.parametrize("system", EXACT, ids=["numbers", "function"])
def test_a_sensor_without_noise_is_refused_where_its_density_is_needed(system):
    others = (
        psf.IPLF(), psf.GridFilter(), psf.BootstrapPF(9), psf.GuidedPF(9), psf.PFEnKF(9),
        psf.EnKF(9),
    )  # fmt: skip
    for filter in others:
        with pytest.raises(ModelError, match=r"sensor without noise .* by EKF\(\), UKF\(\)"):
            psf.log_likelihood(system, filter, {"a": A}, DATA, steps=STEPS)


def test_one_of_two_sensors_without_noise():
    """The AR(2) process of statespace models: the second state is the one before."""
    matrix, cov = np.array([[0.5, 0.3], [1.0, 0.0]]), np.diag([1.0, 0.0])
    system = psf.StateSpaceModel(
        transition=lambda x, q: [0.5 * x[0] + 0.3 * x[1] + q[0], x[0]],
        process_noise=[[1.0]],
        observation=lambda x: [x[0], x[1]],
        observation_noise=lambda r: [[0.0, 0.0], [0.0, r]],
        initial_mean=[0.0, 0.0],
        initial_cov=np.eye(2),
    )
    observed = np.array([[0.3, 0.1], [-0.8, np.nan], [0.4, -0.3]])
    terms = psf.log_likelihood(system, psf.EKF(), {"r": 0.7}, observed, steps=[0, 1, 2])
    expected = kalman_log_likelihood(
        matrix, cov, np.eye(2), np.diag([0.0, 0.7]), [0.0, 0.0], np.eye(2),
        steps=[0, 1, 2], observed=observed,
    )  # fmt: skip
    np.testing.assert_allclose(terms, expected, rtol=1e-12)
    with pytest.raises(ModelError, match="sensor without noise"):
        psf.log_likelihood(system, psf.BootstrapPF(9), {"r": 0.7}, observed, steps=[0, 1, 2])


def test_neither_state_nor_sensor_has_noise():
    system = forced(
        transition=lambda x, a: [a * x[0]], process_noise=None, inputs=(),
        observation_noise=[[0.0]], initial_cov=[[0.0]],
    )  # fmt: skip
    with pytest.raises(ModelError, match="EKF needs the density of an observation"):
        psf.log_likelihood(system, psf.EKF(), {"a": A}, DATA, steps=STEPS)
