"""UKF and IPLF: exact on linear systems, the textbook's elsewhere.

And exact gradients of all Gaussian filters.
"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import pytensor.tensor as pt
import pytest
from scipy.stats import norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.filters.gaussian.linearization import (
    Linearizations,
    Tangent,
    linearizations_of,
)
from pymc_statespace_filters.filters.gaussian.sigma_points import SigmaPoints
from pymc_statespace_filters.ops.base import evaluator, kernel
from pymc_statespace_filters.ops.likelihood import LogLikelihood, TapedLogLikelihood, TapePullback
from pymc_statespace_filters.ops.signatures import POINTS
from pymc_statespace_filters.ops.states import States as StatesOp
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.filters.test_ekf_states import (
    FORCE,
    GAMMA,
    LINEAR,
    NOISE_JAC,
    NONLINEAR,
    OBSERVED,
    ROWS,
    STEPS,
    SYSTEM,
    T0,
    States,
    exact,
    process_cov,
)
from tests.filters.test_truth_ekf import gappy_record
from tests.filters.test_truth_guided import CHAIN
from tests.systems import DUFFING, linear_system

RECORD = (STEPS, OBSERVED, FORCE, T0, 0)
FILTERS = [psf.EKF(), psf.UKF(), psf.IPLF(n_iterations=2)]
GAUSSIAN = pytest.mark.parametrize("filter", FILTERS, ids=lambda f: type(f).__name__)


@dataclass(frozen=True)
class RegressedUKF(psf.UKF):
    """Regressions for all equations, also for those that are linear."""

    def _linearizations(self, system):
        return Linearizations(self.linearization, self.linearization)


def theta_of(params):
    return np.array([params[name] for name in SYSTEM.parameters])


class Evaluation(NamedTuple):
    terms: np.ndarray
    health: np.ndarray
    tape: np.ndarray
    gradient: np.ndarray


@cache
def both_passes(filter, system):
    """The function (theta, record, terms_bar) -> terms, health, tape and gradient."""
    forward = kernel(TapedLogLikelihood(system, filter))
    backward = kernel(TapePullback(system, filter))

    def run(*given):
        *record, terms_bar = given
        terms, health, tape = forward(*record)
        return terms, health, tape, backward(*record, tape, terms_bar)

    return run


def evaluate(filter, theta, terms_bar=None, system=SYSTEM, record=RECORD):
    """Of all terms, or of their sum with these weights."""
    terms_bar = np.ones(len(record[0])) if terms_bar is None else terms_bar
    return Evaluation(*both_passes(filter, system)(theta, *record, terms_bar))


def kalman(params):
    """The exact terms of the system of this file where it is linear."""
    pushes = SYSTEM.dt * (FORCE[:, 0] + 0.3 * np.cos(T0 + SYSTEM.dt * ROWS))
    return kalman_log_likelihood(
        [[1.0, SYSTEM.dt], [-SYSTEM.dt * params["k"], 1.0 - 0.4 * SYSTEM.dt]],
        process_cov(params),
        [[1.0, 0.0], [0.5, 1.0]],
        NOISE_JAC @ GAMMA @ NOISE_JAC.T,
        [0.5, -0.1],
        params["spread"] * np.array([[1.0, 0.5], [0.5, 1.0]]),
        steps=STEPS,
        observed=OBSERVED - params["c"] * FORCE[STEPS] * [0.0, 1.0],
        forcing=np.column_stack([np.zeros(len(FORCE)), pushes]),
    )


@GAUSSIAN
@LINEAR
def test_linear_systems_are_exact(filter, params):
    found = evaluate(filter, theta_of(params))
    np.testing.assert_allclose(found.terms, kalman(params), rtol=1e-9, atol=0.0)
    np.testing.assert_array_equal(found.health, [np.inf, 0.0, -1.0])


@pytest.mark.parametrize("filter", [RegressedUKF(), *FILTERS], ids=lambda f: type(f).__name__)
def test_three_states_without_a_weight_at_the_mean_are_exact(filter):
    """With singular noise, a start known in one direction, and steps before the first datum."""
    steps, observed = gappy_record(len(CHAIN.C), first_step=2)
    terms = psf.log_likelihood(linear_system(CHAIN), filter, {}, observed, steps=steps)
    truth = kalman_log_likelihood(*CHAIN.kalman_arguments(), steps=steps, observed=observed)
    np.testing.assert_allclose(terms, truth, rtol=1e-9, atol=0.0)


@pytest.fixture(scope="module")
def states():
    """The function (filter, moment, params, draw_seed) -> States; each is compiled once."""
    compiled = {}

    def run(filter, moment, params, draw_seed=0):
        if (filter, moment) not in compiled:
            compiled[filter, moment] = evaluator(StatesOp(SYSTEM, filter, moment))
        return States(*compiled[filter, moment](theta_of(params), *RECORD, ROWS, draw_seed))

    return run


@pytest.mark.parametrize("filter", FILTERS[1:], ids=lambda f: type(f).__name__)
@LINEAR
@pytest.mark.parametrize("moment", ["filtered", "smoothed"])
def test_states_of_a_linear_system_are_exact(states, filter, moment, params):
    """With inputs, time, missing components and rows, and noise inside the observation."""
    found, truth = states(filter, moment, params), exact(moment, params)
    np.testing.assert_allclose(found.mean, truth.mean, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found.sd**2, truth.sd**2, rtol=0.0, atol=1e-9)


def see(x, b, push):
    return [x[0] + b * x[0] ** 2, 0.5 * x[0] + x[1] + push]


def move(x, k, stiff, push):
    force = push - k * x[0] - stiff * x[0] ** 3 - 0.4 * x[1]
    return [x[0] + SYSTEM.dt * x[1], x[1] + SYSTEM.dt * force]


def spread(function, mean, cov, *others):
    """Textbook unscented transform for two states, kappa = 1: mean, covariance and Cov(x, y)."""
    root = np.linalg.cholesky(cov)
    points = [mean, *(mean + np.sqrt(3.0) * root.T), *(mean - np.sqrt(3.0) * root.T)]
    w = np.array([1.0, 0.5, 0.5, 0.5, 0.5]) / 3.0
    y = np.array([function(point, *others) for point in points])
    dx, dy = points - mean, y - w @ y
    return w @ y, dy.T @ (w[:, None] * dy), dx.T @ (w[:, None] * dy)


def unscented_smoother(params):
    """Terms, filtered and smoothed moments by the textbook (Sarkka, 2008), regular noise."""
    k, cubic, bend, c = (params[name] for name in ("k", "cubic", "bend", "c"))
    R, dt = NOISE_JAC @ GAMMA @ NOISE_JAC.T, SYSTEM.dt
    m, P = np.array([0.5, -0.1]), params["spread"] * np.array([[1.0, 0.5], [0.5, 1.0]])
    terms, analyses, forecasts = [], [], []
    for step in ROWS:
        u, wave = FORCE[step, 0], np.cos(T0 + dt * step)
        if step in STEPS and not np.isnan(d := OBSERVED[list(STEPS).index(step)]).all():
            b, seen = bend * (1.0 + 0.5 * u), ~np.isnan(d)
            mean, cov, cross = spread(see, m, P, b, c * u)
            S, gap = (cov + R)[np.ix_(seen, seen)], (d - mean)[seen]
            gain = cross[:, seen] @ np.linalg.inv(S)
            m, P = m + gain @ gap, P - gain @ S @ gain.T
            terms.append(-0.5 * (gap @ np.linalg.solve(S, gap)))
            terms[-1] -= 0.5 * np.log(np.linalg.det(2.0 * np.pi * S))
        analyses.append((m, P))
        stiff = cubic * (1.0 + 0.5 * wave + 0.3 * u)

        m, P, cross = spread(move, m, P, k, stiff, u + 0.3 * wave)
        P = P + process_cov(params)
        forecasts.append((m, P, cross))
    smoothed = [analyses[-1]]
    for (m, P), (mf, Pf, cross) in zip(analyses[-2::-1], forecasts[-2::-1], strict=True):
        gain = cross @ np.linalg.inv(Pf)
        ms, Ps = smoothed[0]
        smoothed.insert(0, (m + gain @ (ms - mf), P + gain @ (Ps - Pf) @ gain.T))
    return np.array(terms), analyses, smoothed


def test_ukf_is_the_unscented_filter_and_smoother_of_the_textbook(states):
    terms, filtered, smoothed = unscented_smoother(NONLINEAR)
    value = evaluate(psf.UKF(), theta_of(NONLINEAR)).terms
    np.testing.assert_allclose(value[value != 0.0], terms, rtol=1e-10)
    for moment, truth in [("filtered", filtered), ("smoothed", smoothed)]:
        found = states(psf.UKF(), moment, NONLINEAR)
        np.testing.assert_allclose(found.mean, [m for m, _ in truth], rtol=0.0, atol=1e-10)
        np.testing.assert_allclose(found.sd**2, [P.diagonal() for _, P in truth], atol=1e-10)


def test_one_iteration_of_iplf_is_the_update_of_ukf():
    """For the state; the likelihood is another approximation of the same integral.

    The tape has the mean and the covariance before every prediction and every update.
    """
    ukf = evaluate(psf.UKF(), theta_of(NONLINEAR)).tape
    forward = evaluator(TapedLogLikelihood(SYSTEM, psf.IPLF(n_iterations=1)))
    _, _, iplf = forward(theta_of(NONLINEAR), *RECORD)
    assert len(ukf) == STEPS[-1] + len(STEPS)
    np.testing.assert_allclose(iplf, ukf, rtol=1e-10, atol=1e-12)


SQUARE = psf.StateSpaceModel(
    transition=lambda x: [x[0]],
    observation=lambda x, square=1.0, cube=0.0: [square * x[0] ** 2 + cube * x[0] ** 3],
    observation_noise=lambda r: [[r]],
    initial_mean=lambda m: [m],
    initial_cov=lambda p: [[p]],
)


def test_ukf_knows_mean_and_variance_of_a_square():
    m, p, r, d = 0.7, 0.6, 0.2, 1.9
    run = psf.run_filter(SQUARE, psf.UKF(), {"m": m, "p": p, "r": r}, [d], steps=[0])
    mean, variance = m**2 + p, 4.0 * m**2 * p + 2.0 * p**2 + r
    term = -0.5 * (d - mean) ** 2 / variance - 0.5 * np.log(2.0 * np.pi * variance)
    np.testing.assert_allclose(run["log_likelihood"], [term], rtol=1e-13)
    gain = 2.0 * m * p / variance
    np.testing.assert_allclose(run["mean"].values.item(), m + gain * (d - mean), rtol=1e-13)
    np.testing.assert_allclose(run["cov"].values.item(), p - gain * 2.0 * m * p, rtol=1e-12)


def test_noise_and_sensors_that_all_bend_have_covariances():
    """Two products of two correlated states, and noise that grows with one of them."""
    m, P, d = np.array([0.7, -0.4]), np.array([[0.6, 0.2], [0.2, 0.3]]), np.array([1.1, 0.3])
    Gamma = np.array([[0.2, 0.05], [0.05, 0.1]])

    def products(x):
        return [x[0] ** 2, x[0] * x[1]]

    system = psf.StateSpaceModel(
        transition=lambda x: [x[0], x[1]],
        observation=lambda x, e: [x[0] ** 2 + e[0], x[0] * x[1] + x[0] * e[1]],
        observation_noise=Gamma,
        initial_mean=m,
        initial_cov=P,
    )
    run = psf.run_filter(system, psf.UKF(), {}, d[None], steps=[0])
    mean, cov, cross = spread(products, m, P)
    # E[D Gamma D'] with D = diag(1, x0)
    S = cov + Gamma * np.array([[1.0, m[0]], [m[0], m[0] ** 2 + P[0, 0]]])
    term = -0.5 * (d - mean) @ np.linalg.solve(S, d - mean)
    term -= 0.5 * np.log(np.linalg.det(2.0 * np.pi * S))
    np.testing.assert_allclose(run["log_likelihood"], [term], rtol=1e-12)
    gain = cross @ np.linalg.inv(S)
    np.testing.assert_allclose(run["mean"].values.ravel(), m + gain @ (d - mean), rtol=1e-12)
    np.testing.assert_allclose(run["cov"].values.reshape(2, 2), P - gain @ S @ gain.T, rtol=1e-11)


def test_default_points_are_those_of_the_cubature_filter_from_three_states_on():
    squares = [SigmaPoints().squared_distance(n) for n in (1, 2, 3, 4, 14)]
    assert squares == [3.0, 3.0, 3.0, 4.0, 14.0]


def regression_of_a_square(m, p):
    """Mean, slope and remaining variance of the square of N(m, p)."""
    return m**2 + p, 2.0 * m, 2.0 * p**2


def test_iplf_iterates_over_the_posterior():
    """The iteration written out for a square, and the density by points of its posterior."""
    m, p, r, d = 0.7, 0.6, 0.05, 1.9
    run = psf.run_filter(SQUARE, psf.IPLF(), {"m": m, "p": p, "r": r}, [d], steps=[0])
    mean, variance, means = m, p, []
    for _ in range(5):
        level, slope, rest = regression_of_a_square(mean, variance)
        total = slope**2 * p + rest + r
        gain = p * slope / total
        predicted = level + slope * (m - mean)
        mean, variance = m + gain * (d - predicted), p - gain**2 * total
        means.append(mean)
    assert abs(means[-1] - means[0]) > 0.05
    np.testing.assert_allclose(run["mean"].values.item(), mean, rtol=1e-11)
    np.testing.assert_allclose(run["cov"].values.item(), variance, rtol=1e-11)
    x = mean + np.sqrt(3.0 * variance) * np.array([0.0, 1.0, -1.0])
    ratio = norm.pdf(d, x**2, np.sqrt(r)) * norm.pdf(x, m, np.sqrt(p))
    ratio /= norm.pdf(x, mean, np.sqrt(variance))
    term = np.log(np.array([4.0, 1.0, 1.0]) / 6.0 @ ratio)
    np.testing.assert_allclose(run["log_likelihood"], [term], rtol=1e-10)


def test_the_scaling_is_that_of_wan_and_van_der_merwe():
    """Mean and variance of a cube for weights that are not the default's, written out."""
    alpha, beta, kappa, m, p, r, d = 0.6, 2.0, 0.5, 0.7, 0.6, 0.2, 1.9
    params = {"m": m, "p": p, "r": r, "square": 0.0, "cube": 1.0}
    scale = alpha**2 * (1.0 + kappa)
    y = (m + np.sqrt(scale * p) * np.array([0.0, 1.0, -1.0])) ** 3
    w = np.array([1.0 - 1.0 / scale, 0.5 / scale, 0.5 / scale])
    mean = w @ y
    w[0] += 1.0 - alpha**2 + beta
    variance = w @ (y - mean) ** 2 + r
    term = -0.5 * (d - mean) ** 2 / variance - 0.5 * np.log(2.0 * np.pi * variance)
    scaled = psf.UKF(alpha=alpha, beta=beta, kappa=kappa)
    np.testing.assert_allclose(psf.log_likelihood(SQUARE, scaled, params, [d], steps=[0]), term)


@GAUSSIAN
def test_a_batch_is_its_points(filter):
    points = theta_of(NONLINEAR) * np.random.default_rng(2).uniform(0.7, 1.3, size=(11, 7))
    terms, health = evaluator(LogLikelihood(SYSTEM, filter, POINTS))(points, *RECORD)
    for i, point in enumerate(points):
        one = evaluate(filter, point)
        np.testing.assert_allclose(terms[i], one.terms, rtol=1e-10)
        np.testing.assert_array_equal(health[i], one.health)


NINTH_ORDER = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])


def differences(value, theta, step=4e-3):
    """Gradient by central differences of eighth order."""
    h = step * np.maximum(np.abs(theta), 0.1)
    moves = np.arange(-4, 5)[:, None, None] * np.diag(h)
    values = [[value(theta + move) for move in of_step] for of_step in moves]
    return NINTH_ORDER @ np.array(values) / h


@GAUSSIAN
@pytest.mark.parametrize("params", [NONLINEAR, NONLINEAR | {"shake": 1e-2}])
def test_the_gradient_is_that_of_the_likelihood(filter, params):
    found = evaluate(filter, theta_of(params)).gradient
    slopes = differences(lambda theta: evaluate(filter, theta).terms.sum(), theta_of(params))
    np.testing.assert_allclose(found, slopes, rtol=1e-8, atol=1e-9)


@GAUSSIAN
@LINEAR
def test_the_gradient_on_a_linear_system_is_that_of_the_kalman_filter(filter, params):
    """By those parameters that keep the system linear, and are not at their lower boundary."""
    terms_bar = np.linspace(-1.0, 2.0, len(STEPS))
    names = [n for n in SYSTEM.parameters if n not in ("cubic", "bend") and params[n] != 0.0]

    def value(theta):
        return kalman(params | dict(zip(names, theta, strict=True))) @ terms_bar

    slopes = differences(value, np.array([params[n] for n in names]), step=8e-3)
    found = evaluate(filter, theta_of(params), terms_bar).gradient
    at = [SYSTEM.parameters.index(n) for n in names]
    np.testing.assert_allclose(found[at], slopes, rtol=1e-9)


@GAUSSIAN
def test_the_gradient_is_exact_with_a_known_start_and_noise_on_the_velocity(filter):
    """By all parameters but the variance of the start, which is at its lower boundary."""
    observed = np.array([[0.4, np.nan], [0.7, np.nan], [0.1, -0.2]])
    record = (np.array([0, 2, 7]), observed, np.zeros((0, 0)), 0.0, 0)
    point = {"k": 1.3, "c": 0.4, "s": 0.7, "b": 0.2, "r": 0.1, "m": 0.5}
    theta = np.array([*point.values()])
    assert DUFFING.parameters == (*point, "v")

    def at(theta):
        return evaluate(filter, np.append(theta, 0.0), system=DUFFING, record=record)

    slopes = differences(lambda theta: at(theta).terms.sum(), theta)
    np.testing.assert_allclose(at(theta).gradient[:-1], slopes, rtol=1e-8, atol=1e-9)


def test_linear_equations_take_their_tangent():
    """With the likelihood of the regression, which is exact there too."""
    points, tangent = psf.UKF().linearization, Tangent()
    assert linearizations_of(linear_system(CHAIN), points) == (tangent, tangent)
    assert linearizations_of(SQUARE, points) == (tangent, points)
    steps, observed = np.array([0, 3, 4]), np.array([0.8, np.nan, -0.3])
    sine = psf.StateSpaceModel(
        transition=lambda x, q: [pt.sin(2.0 * x[0]) + q[0]],
        process_noise=[[0.3]],
        observation=lambda x, e, u: [x[0] + u[0] * e[0]],
        observation_noise=[[0.2]],
        initial_mean=[0.4],
        initial_cov=[[0.5]],
        inputs=["gain"],
    )
    assert linearizations_of(sine, points) == (points, tangent)
    record = {"observed": observed, "steps": steps, "inputs": np.linspace(0.5, 2.0, 5)}
    terms = psf.log_likelihood(sine, psf.UKF(), {}, **record)
    regressed = psf.log_likelihood(sine, RegressedUKF(), {}, **record)
    np.testing.assert_allclose(terms, regressed, rtol=1e-13)


@GAUSSIAN
def test_impossible_settings_and_systems_are_refused(filter):
    name = type(filter).__name__
    memory = psf.StateSpaceModel(
        lambda x: [x[0]], lambda x: [x[0]], observation_noise=[[1.0]], initial_mean=[0.0],
        initial_cov=[[1.0]], states=["branch"], carried=["branch"],
    )  # fmt: skip
    with pytest.raises(psf.errors.ModelError, match=rf"{name} cannot treat the carried states"):
        psf.log_likelihood(memory, filter, {}, [0.3], steps=[0])


def test_systems_too_large_to_be_written_out_run_on_arrays():
    """Fourteen coupled states, half of them known at the start."""
    n, steps = 14, np.array([0, 2, 3])
    A = 0.85 * np.eye(n) + 0.05 * np.roll(np.eye(n), 1, axis=1)
    B, C, start = 0.3 * np.eye(n)[:, ::2], np.eye(n)[::5], np.diag(np.arange(n) % 2.0)
    ring = psf.StateSpaceModel(
        transition=lambda x, q, a: a * (pt.as_tensor(A) @ x) + B @ q,
        process_noise=np.eye(n // 2),
        observation=lambda x: C @ x,
        observation_noise=0.2 * np.eye(3),
        initial_mean=np.ones(n),
        initial_cov=start,
    )
    observed = np.random.default_rng(20).normal(size=(3, 3))
    observed[1, 1] = np.nan
    found = psf.log_likelihood(ring, RegressedUKF(), {"a": 0.9}, observed, steps=steps)
    truth = kalman_log_likelihood(
        0.9 * A, B @ B.T, C, 0.2 * np.eye(3), np.ones(n), start, steps=steps, observed=observed
    )
    np.testing.assert_allclose(found, truth, rtol=1e-9)
