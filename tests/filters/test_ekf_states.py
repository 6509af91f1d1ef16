"""States by the EKF: exact on linear systems, and draws that have the joint law.

One system serves for all: it is linear if ``cubic`` and ``bend`` are zero, its process noise acts
on the velocity alone if ``shake`` is, and its start is known if ``spread`` is.
"""

from typing import NamedTuple

import numpy as np
import pytensor.tensor as pt
import pytest
from scipy import stats

import pymc_statespace_filters as psf
from pymc_statespace_filters.filters.outcomes import Failure
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.states import States as StatesOp
from tests.references.linear_states import linear_states

DT, T0 = 0.2, 1.5
STEPS = np.array([0, 2, 3, 7, 8, 13])
ROWS = np.arange(14)
OBSERVED = np.array(
    [[0.4, -0.2], [np.nan, 0.5], [0.9, 0.1], [np.nan, np.nan], [-0.3, np.nan], [0.6, -0.8]]
)
FORCE = np.random.default_rng(5).normal(size=(14, 1))
GAMMA = np.array([[0.30, 0.06], [0.06, 0.40]])
REGULAR = {"k": 1.2, "cubic": 0.0, "bend": 0.0, "push": 0.7, "shake": 0.3, "spread": 0.6, "c": 0.5}
SINGULAR = REGULAR | {"shake": 0.0, "spread": 0.0}
NONLINEAR = REGULAR | {"cubic": 0.8, "bend": 0.3}
NOISE_JAC = np.array([[1.0, 0.0], [0.5, 1.0]])


def transition(x, q, u, t, k, cubic):
    """A driven oscillator with a spring that stiffens, more so in time with what drives it."""
    spring = k * x[0] + cubic * (1.0 + 0.5 * pt.cos(t) + 0.3 * u[0]) * x[0] ** 3
    force = u[0] + 0.3 * pt.cos(t) - spring - 0.4 * x[1]
    return [x[0] + DT * x[1] + q[0], x[1] + DT * force + q[1]]


def observation(x, e, u, bend, c):
    """Two sensors with general noise, one of which feels the input."""
    bent = bend * (1.0 + 0.5 * u[0]) * x[0] ** 2
    return [x[0] + bent + e[0], 0.5 * x[0] + x[1] + c * u[0] + 0.5 * e[0] + e[1]]


SYSTEM = psf.StateSpaceModel(
    transition=transition,
    process_noise=lambda shake, push: [
        [shake**2, 0.5 * shake * push],
        [0.5 * shake * push, push**2],
    ],
    observation=observation,
    observation_noise=GAMMA,
    initial_mean=[0.5, -0.1],
    initial_cov=lambda spread: [[spread, 0.5 * spread], [0.5 * spread, spread]],
    dt=DT,
    inputs=["force"],
)


class States(NamedTuple):
    """What a filter gives."""

    mean: np.ndarray
    sd: np.ndarray
    drawn: np.ndarray
    n_effective: np.ndarray
    health: np.ndarray


@pytest.fixture(scope="module")
def states():
    """The function (moment, params, ...) -> States."""
    functions = {
        moment: evaluator(StatesOp(SYSTEM, psf.EKF(), moment))
        for moment in ("predicted", "filtered", "smoothed")
    }

    def run(moment, params, steps=STEPS, observed=OBSERVED, rows=ROWS, draw_seed=0):
        theta = np.array([params[name] for name in SYSTEM.parameters])
        record = (steps, observed, FORCE, T0, 0)
        return States(
            *functions[moment](theta, *record, np.asarray(rows, dtype=np.int64), draw_seed)
        )

    return run


def process_cov(params):
    shake, push = params["shake"], params["push"]
    return np.array([[shake**2, 0.5 * shake * push], [0.5 * shake * push, push**2]])


def exact(moment, params, steps=STEPS, observed=OBSERVED, rows=ROWS):
    """The law of the states of the linear system, all at once."""
    time = T0 + DT * np.arange(len(FORCE))
    pushes = DT * (FORCE[:, 0] + 0.3 * np.cos(time))
    return linear_states(
        [[1.0, DT], [-DT * params["k"], 1.0 - 0.4 * DT]],
        process_cov(params),
        [[1.0, 0.0], [0.5, 1.0]],
        NOISE_JAC @ GAMMA @ NOISE_JAC.T,
        [0.5, -0.1],
        params["spread"] * np.array([[1.0, 0.5], [0.5, 1.0]]),
        steps=steps,
        observed=observed - params["c"] * FORCE[steps] * [0.0, 1.0],
        rows=np.asarray(rows),
        moment=moment,
        forcing=np.column_stack([np.zeros(len(FORCE)), pushes]),
    )


MOMENTS = pytest.mark.parametrize("moment", ["predicted", "filtered", "smoothed"])
LINEAR = pytest.mark.parametrize("params", [REGULAR, SINGULAR], ids=["regular", "singular"])


@MOMENTS
@LINEAR
@pytest.mark.parametrize("first", [0, 1], ids=["from_step_0", "later"])
def test_states_of_a_linear_system_are_exact(states, moment, params, first):
    record = (STEPS[first:], OBSERVED[first:])
    found, truth = states(moment, params, *record), exact(moment, params, *record)
    np.testing.assert_allclose(found.mean, truth.mean, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found.sd**2, truth.sd**2, rtol=0.0, atol=1e-12)
    assert (found.n_effective == np.inf).all()
    np.testing.assert_array_equal(found.health, [np.inf, 0.0, -1.0])


@MOMENTS
def test_a_row_does_not_depend_on_which_others_are_asked_for(states, moment):
    few, all_rows = [0, 4, 7, 8], states(moment, REGULAR)
    found = states(moment, REGULAR, rows=few)
    for some, every in zip(found[:3], all_rows[:3], strict=True):
        np.testing.assert_array_equal(some, every[few])
    assert states(moment, REGULAR, rows=[]).mean.shape == (0, 2)


@MOMENTS
def test_draws_are_a_function_of_their_seed(states, moment):
    first, again, other = (states(moment, REGULAR, draw_seed=seed).drawn for seed in (1, 1, -2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()


def assert_drawn_from(draws, mean, cov, error_rate):
    """Mean and covariance of independent draws (N, r) are these, by two chi-square tests.

    In directions without spread the draws are the mean itself.
    """
    variances, directions = np.linalg.eigh(cov)
    centred = (draws - mean) @ directions
    flat = variances < 1e-12
    np.testing.assert_allclose(centred[:, flat], 0.0, atol=1e-8)
    z = centred[:, ~flat] / np.sqrt(variances[~flat])
    n_draws, r = z.shape
    if r == 0:
        return
    scatter = z.T @ z / n_draws - np.eye(r)
    for statistic, freedom in [
        (n_draws * (z.mean(axis=0) ** 2).sum(), r),
        (0.5 * n_draws * (scatter**2).sum(), r * (r + 1) / 2),
    ]:
        p = stats.chi2.sf(statistic, freedom)
        # Too good is wrong too: draws that are not independent, or not drawn.
        assert 0.5 * error_rate < p < 1.0 - 0.5 * error_rate, (statistic, freedom)


def test_smoothed_draws_are_paths_of_the_joint_law(states):
    """With singular noise and a known start. Two tests that each fail a right one once in 1e4."""
    paths = np.array([states("smoothed", SINGULAR, draw_seed=i).drawn for i in range(4000)])
    truth = exact("smoothed", SINGULAR)
    size = truth.mean.size
    cov = truth.cov.reshape(size, size)
    assert np.linalg.matrix_rank(cov, tol=1e-12) < size
    assert_drawn_from(paths.reshape(4000, size), truth.mean.ravel(), cov, 1e-4)


def test_smoothed_draws_have_the_joint_law_with_regular_noise_too(states):
    """Rows apart, so that memory over several steps counts. Fails once in 1e4, twice."""
    rows = [0, 1, 5, 7, 10, 13]
    paths = np.array(
        [states("smoothed", REGULAR, rows=rows, draw_seed=i).drawn for i in range(4000)]
    )
    truth = exact("smoothed", REGULAR, rows=rows)
    assert_drawn_from(paths.reshape(4000, 12), truth.mean.ravel(), truth.cov.reshape(12, 12), 1e-4)


@pytest.mark.parametrize("moment", ["predicted", "filtered"])
@LINEAR
def test_draws_have_the_law_of_their_row(states, moment, params):
    """Fourteen rows, two tests each: a right one fails once in a thousand."""
    draws = np.array([states(moment, params, draw_seed=i).drawn for i in range(2000)])
    truth = exact(moment, params)
    for i in range(len(ROWS)):
        assert_drawn_from(draws[:, i], truth.mean[i], truth.cov[i, :, i], 1e-3 / 28)


def extended_smoother(params):
    """Means (14, 2) and covariances by the recursion of Rauch, Tung and Striebel, regular noise.

    And the terms of the likelihood.
    """
    k, cubic, bend, c = (params[name] for name in ("k", "cubic", "bend", "c"))
    R = NOISE_JAC @ GAMMA @ NOISE_JAC.T
    m, P = np.array([0.5, -0.1]), params["spread"] * np.array([[1.0, 0.5], [0.5, 1.0]])
    forecasts, analyses, jacobians, terms = [], [], [], []
    for step in ROWS:
        forecasts.append((m, P))
        if step in STEPS:
            d, u = OBSERVED[list(STEPS).index(step)], FORCE[step, 0]
            seen = ~np.isnan(d)
            b = bend * (1.0 + 0.5 * u)
            h = np.array([m[0] + b * m[0] ** 2, 0.5 * m[0] + m[1] + c * u])[seen]
            H = np.array([[1.0 + 2.0 * b * m[0], 0.0], [0.5, 1.0]])[seen]
            S = H @ P @ H.T + R[np.ix_(seen, seen)]
            gain = P @ H.T @ np.linalg.inv(S)
            terms.append(stats.multivariate_normal(h, S).logpdf(d[seen]) if seen.any() else 0.0)
            m, P = m + gain @ (d[seen] - h), P - gain @ H @ P
        analyses.append((m, P))
        wave, u = np.cos(T0 + DT * step), FORCE[step, 0]
        stiff = cubic * (1.0 + 0.5 * wave + 0.3 * u)
        F = np.array([[1.0, DT], [-DT * (k + 3.0 * stiff * m[0] ** 2), 1.0 - 0.4 * DT]])
        force = u + 0.3 * wave - k * m[0] - stiff * m[0] ** 3 - 0.4 * m[1]
        m = m + DT * np.array([m[1], force])
        P = F @ P @ F.T + process_cov(params)
        jacobians.append(F)
    smoothed = [analyses[-1]]
    for step in ROWS[-2::-1]:
        (m, P), (mf, Pf), (ms, Ps) = analyses[step], forecasts[step + 1], smoothed[0]
        gain = P @ jacobians[step].T @ np.linalg.inv(Pf)
        smoothed.insert(0, (m + gain @ (ms - mf), P + gain @ (Ps - Pf) @ gain.T))
    means, covs = zip(*smoothed, strict=True)
    return np.array(means), np.array(covs), terms


def test_the_extended_smoother_is_linear_around_the_means_of_the_filter(states):
    found, (mean, cov, terms) = states("smoothed", NONLINEAR), extended_smoother(NONLINEAR)
    record = {"observed": OBSERVED, "steps": STEPS, "inputs": FORCE, "t0": T0}
    np.testing.assert_allclose(psf.log_likelihood(SYSTEM, psf.EKF(), NONLINEAR, **record), terms)
    np.testing.assert_allclose(found.mean, mean, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found.sd**2, np.diagonal(cov, axis1=1, axis2=2), atol=1e-12)
    # A draw for each step alone: mean and covariance, 14 times; a right one fails once in 1000.
    draws = np.array([states("smoothed", NONLINEAR, draw_seed=i).drawn for i in range(2000)])
    for i in range(len(ROWS)):
        assert_drawn_from(draws[:, i], mean[i], cov[i], 1e-3 / 28)


@MOMENTS
def test_states_end_where_an_observation_fails(states, moment):
    observed = OBSERVED.copy()
    observed[4] = np.inf  # at step 8
    found, whole = states(moment, REGULAR, observed=observed), states(moment, REGULAR)
    lost = ROWS >= (0 if moment == "smoothed" else 8)
    for values, unbroken in zip(found[:4], whole[:4], strict=True):
        assert np.isnan(values[lost]).all()
        if moment == "predicted" or moment == "filtered":
            np.testing.assert_array_equal(values[~lost], unbroken[~lost])
    np.testing.assert_array_equal(found.health, [np.inf, Failure.ZERO_DENSITY, 4.0])


@MOMENTS
def test_impossible_parameters_have_no_states(states, moment):
    found = states(moment, REGULAR | {"spread": -0.1})
    assert all(np.isnan(values).all() for values in found[:4])
    np.testing.assert_array_equal(found.health, [np.inf, Failure.INITIAL_COV, 0.0])


@pytest.mark.slow
@MOMENTS
def test_twenty_states_run_on_arrays(moment):
    """Half of them known at the start, half without noise. Mostly compilation, half a minute."""
    n = 20
    A = 0.85 * np.eye(n) + 0.05 * np.roll(np.eye(n), 1, axis=1)
    B, C, start = 0.3 * np.eye(n)[:, ::2], np.eye(n)[::4], np.diag(np.arange(n) % 2.0)
    ring = psf.StateSpaceModel(
        transition=lambda x, q: A @ x + B @ q,
        process_noise=np.eye(n // 2),
        observation=lambda x: C @ x,
        observation_noise=0.2 * np.eye(5),
        initial_mean=np.ones(n),
        initial_cov=start,
    )
    steps, rows = np.array([0, 2, 5]), np.arange(6)
    observed = np.random.default_rng(20).normal(size=(3, 5))
    observed[1, 1] = np.nan
    run = evaluator(StatesOp(ring, psf.EKF(), moment))
    record = (np.zeros(0), steps, observed, np.zeros((0, 0)), 0.0, 0, rows)
    found, law = States(*run(*record, 0)), (A, B @ B.T, C, 0.2 * np.eye(5), np.ones(n), start)
    truth = linear_states(*law, steps=steps, observed=observed, rows=rows, moment=moment)
    np.testing.assert_allclose(found.mean, truth.mean, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found.sd**2, truth.sd**2, rtol=0.0, atol=1e-12)
    # Six rows, two tests each: a right one fails once in a thousand.
    draws = np.array([States(*run(*record, seed)).drawn for seed in range(1000)])
    for i in range(len(rows)):
        assert_drawn_from(draws[:, i], truth.mean[i], truth.cov[i, :, i], 1e-3 / 12)
