"""GridFilter where no uniform grid holds the density, against sums over dense matrices."""

from functools import cache

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from numba import njit
from numpy.polynomial import Polynomial
from scipy.stats import kstest, norm, poisson

import pymc_statespace_filters as psf
from pymc_statespace_filters.filters.outcomes import NONE, TOO_FAR, Failure
from pymc_statespace_filters.filters.point_mass.segments import POINTS, draw, points_of, weight
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.states import Predictions, States
from tests.references.fixed_nodes import FixedNodes

MOMENTS = ("predicted", "filtered", "smoothed")
LOG_GROWTH = 3.8


def ricker_counts(n=30, seed=5):
    """Counts of a map whose log abundance falls to -40 and comes back."""
    rng = np.random.default_rng(seed)
    x, counts = np.log(7.0), []
    for _ in range(n):
        counts.append(rng.poisson(10.0 * np.exp(x)))
        x = LOG_GROWTH + x - np.exp(x) + 0.3 * rng.standard_normal()
    return np.array(counts, float)


def gaussian(d, sd=0.2):
    return lambda x: norm.pdf(d, x, sd)


def counted(d, rate):
    return lambda x: poisson.pmf(d, np.maximum(rate(x), 0.0)) * (rate(x) >= 0.0)


def system(transition, *, start, spread, noise=0.1, sensor=0.2, rate=None):
    """One state, from N(start, spread^2), seen with normal errors or as counts at a rate."""
    seen = {"observation": lambda x: [x[0]], "observation_noise": [[sensor**2]]}
    if rate is not None:
        seen = {"observation_dist": lambda x: [pm.Poisson.dist(mu=rate(x[0]))]}
    return psf.StateSpaceModel(
        lambda x, q: [transition(x[0], q[0])],
        process_noise=[[noise**2]],
        initial_mean=[start],
        initial_cov=[[spread**2]],
        **seen,
    )


def logarithmic(**settings):
    return system(lambda x, q: x + 0.1 * pt.log(x) + q, start=0.5, spread=0.3, **settings)


LOG = logarithmic()
ROOT = system(lambda x, q: 0.9 * x + 0.2 * pt.sqrt(x) + q, start=0.3, spread=0.2)
ROOT_NOISE = system(
    lambda x, q: x + 0.1 * (1.0 - x) + 0.2 * pt.sqrt(x) * q, start=1.0, spread=0.1, noise=1.0
)
COUNTED = system(lambda x, q: 0.9 * x + q, start=0.4, spread=0.3, noise=0.2, rate=lambda x: 4.0 * x)
RICKER = system(
    lambda x, q: LOG_GROWTH + x - pt.exp(x) + q,
    start=np.log(7.0),
    spread=0.0,
    noise=0.3,
    rate=lambda x: 10.0 * pt.exp(x),
)
CLIPPED = system(
    lambda x, q: 0.8 * x + q,
    start=0.5,
    spread=1.0,
    noise=0.5,
    rate=lambda x: pt.clip(3.0 * x, 0.1, 5.0),
)

STEPS, DATA = np.array([0, 1, 2, 3, 5, 8]), np.array([0.45, 0.5, np.nan, 0.2, 0.4, 0.5])
SURPRISING = np.array([0.45, 0.5, np.nan, 2.3, 0.4, 0.5])  # needs a longer reach
COUNTS = np.array([1.0, 0.0, np.nan, 2.0, 0.0, 3.0])
# Towards zero ever narrower: there the logarithm and the root bend without limit.
NEAR_ZERO = np.append(0.0, 0.5 ** np.arange(40, 4, -1.0))


def edges(lowest, highest, width):
    below = np.arange(lowest, 0.0, width) if lowest < 0.0 else []
    return np.concatenate([below, NEAR_ZERO, np.arange(width, highest, width)])


def by_step(likelihood, data=DATA):
    """What is observed at each step, or None."""
    out = [None] * (STEPS[-1] + 1)
    for k, d in zip(STEPS, data, strict=True):
        out[k] = None if np.isnan(d) else likelihood(d)
    return out


@cache
def case(name):
    """(system, steps, observed, reference)."""
    if name == "ricker":
        counts = ricker_counts()
        fine, coarse = np.arange(-2.0, 6.0, 0.12), np.arange(-60.0, -2.0, 0.3)
        reference = FixedNodes(
            [*coarse, *fine],
            lambda x: LOG_GROWTH + x - np.exp(x),
            lambda x: 0.3,
            np.log(7.0),
            [counted(d, lambda x: 10.0 * np.exp(x)) for d in counts],
        )
        return RICKER, np.arange(counts.size), counts, reference
    if name.startswith("log"):
        data = SURPRISING if name == "log, surprise" else DATA
        mean, sd = lambda x: x + 0.1 * np.log(x), lambda x: 0.1
        start, rows = lambda x: norm.pdf(x, 0.5, 0.3), by_step(gaussian, data)
        return LOG, STEPS, data, FixedNodes(edges(-3.0, 4.0, 0.08), mean, sd, start, rows)
    if name == "root":
        mean, sd = lambda x: 0.9 * x + 0.2 * np.sqrt(x), lambda x: 0.1
        start, rows = lambda x: norm.pdf(x, 0.3, 0.2), by_step(gaussian)
        return ROOT, STEPS, DATA, FixedNodes(edges(-2.0, 3.0, 0.08), mean, sd, start, rows)
    if name == "root noise":
        mean, sd = lambda x: x + 0.1 * (1.0 - x), lambda x: 0.2 * np.sqrt(x)
        start, rows = lambda x: norm.pdf(x, 1.0, 0.1), by_step(gaussian)
        return ROOT_NOISE, STEPS, DATA, FixedNodes(edges(-0.5, 3.5, 0.02), mean, sd, start, rows)
    mean, sd = lambda x: 0.9 * x, lambda x: 0.2
    start = lambda x: norm.pdf(x, 0.4, 0.3)  # noqa: E731
    rows = by_step(lambda d: counted(d, lambda x: 4.0 * x), COUNTS)
    return COUNTED, STEPS, COUNTS, FixedNodes(edges(-4.0, 5.0, 0.08), mean, sd, start, rows)


CASES = ("ricker", "log", "log, surprise", "root", "root noise", "counted")
# Beside the root, dense matrices with noise that vanishes are themselves good to 1e-7.
ATOL = {"root noise": 1e-6}


@pytest.mark.parametrize("tolerance", [1e-8, 1e-3])
@pytest.mark.parametrize("name", CASES)
def test_terms_are_those_of_dense_matrices(name, tolerance):
    model, steps, observed, reference = case(name)
    terms = psf.log_likelihood(
        model, psf.GridFilter(tolerance=tolerance), {}, observed, steps=steps
    )
    atol = max(ATOL.get(name, 1e-8), tolerance)
    np.testing.assert_allclose(terms, np.array(reference.terms)[steps], rtol=0.0, atol=atol)


def compiled(name, kind, *arguments, filter=psf.GridFilter()):  # noqa: B008 (it is frozen)
    """An operation of the filter, as a function of further arguments."""
    model, steps, observed, _ = case(name)
    function = evaluator(kind(model, filter, *arguments))
    record = np.empty(0), steps.astype(np.int64), observed[:, None], np.empty((steps[-1] + 1, 0))
    return lambda *rest: function(*record, 0.0, 0, *rest)


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("name", CASES)
def test_states_are_those_of_dense_matrices(name, moment):
    _, steps, _, reference = case(name)
    rows = np.arange(1, steps[-1] + 1)  # step 0 of one case is known, which nodes cannot hold
    mean, sd, _, n_effective, health = compiled(name, States, moment)(rows, 0)
    law, atol = reference.law(moment), ATOL.get(name, 1e-7)
    np.testing.assert_array_equal(health, [np.inf, NONE, -1.0])
    assert (n_effective == np.inf).all()
    np.testing.assert_allclose(mean[:, 0], law.mean[rows], rtol=0.0, atol=atol)
    np.testing.assert_allclose(sd[:, 0], law.sd[rows], rtol=0.0, atol=atol)


def test_a_known_start_is_drawn_as_it_is():
    for moment in MOMENTS:
        mean, sd, drawn, _, _ = compiled("ricker", States, moment)(np.arange(2), 3)
        assert mean[0, 0] == drawn[0, 0] == np.log(7.0)
        assert sd[0, 0] == 0.0


@njit
def points_and_weights(low, high):
    x, weights = np.empty(POINTS), np.empty(POINTS)
    points_of(low, high, x)
    for i in range(POINTS):
        weights[i] = weight(low, high, i)
    return x, weights


@njit
def inverse(low, high, mass, u):
    return draw(low, high, mass, u)


def test_draws_invert_the_distribution_function():
    """Exactly: the density is a polynomial of degree 9 on each of two segments."""
    low, high = np.array([-1.0, 0.5]), np.array([0.5, 1.0])
    density = Polynomial([1.0, 0.3, 0.0, -0.5, 0.0, 0.2, 0.0, 0.0, 0.0, 0.4])
    both = [points_and_weights(*ends) for ends in zip(low, high, strict=True)]
    mass = np.array([density(x) * weights for x, weights in both])
    cdf = density.integ(lbnd=-1.0)
    for u in (1e-12, 1e-3, 0.4, 0.7, 0.9, 1.0 - 1e-9):
        assert cdf(inverse(low, high, mass, u)) / cdf(1.0) == pytest.approx(u, abs=1e-13)


N_DRAWS = 120


def test_smoothed_draws_are_trajectories():
    """Two Kolmogorov-Smirnov tests and a covariance; a right one fails one time in 10^4.

    The error of the grid is a hundredth of what these can tell.
    """
    reference, rows = case("log")[3], np.array([4, 5])
    run = compiled("log", States, "smoothed", filter=psf.GridFilter(tolerance=1e-3))
    drawn = np.array([run(rows, seed)[2][:, 0] for seed in range(N_DRAWS)])
    for i, k in enumerate(rows):
        cdf = np.cumsum(reference.law("smoothed").density[k] * reference.weights)
        law = lambda x, cdf=cdf: np.interp(x, reference.x, cdf)  # noqa: E731
        assert kstest(drawn[:, i], law).pvalue > 1e-5
    product = drawn[:, 0] * drawn[:, 1]
    error = product.std() / np.sqrt(N_DRAWS)
    assert abs(product.mean() - reference.mean_product(4)) < 4.5 * error


@pytest.mark.parametrize("name", ["log", "log, surprise"])
def test_laws_of_observations(name):
    _, steps, observed, reference = case(name)
    mean, cov, below, above = compiled(name, Predictions)()
    x, weights = reference.x, reference.weights
    for j, k in enumerate(steps):
        mass = reference.law("predicted").density[k] * weights
        first = mass @ x
        np.testing.assert_allclose(mean[j, 0], first, atol=1e-7)
        np.testing.assert_allclose(cov[j, 0, 0], mass @ (x - first) ** 2 + 0.04, atol=1e-7)
        if not np.isnan(observed[j]):
            z = (observed[j] - x) / 0.2
            np.testing.assert_allclose(below[j, 0], np.log(mass @ norm.cdf(z)), atol=1e-7)
            np.testing.assert_allclose(above[j, 0], np.log(mass @ norm.sf(z)), atol=1e-7)


def test_one_run_has_terms_and_filtered_states():
    model, steps, observed, reference = case("ricker")
    run = psf.run_filter(model, psf.GridFilter(), {}, observed, steps=steps)
    np.testing.assert_allclose(run["log_likelihood"], np.array(reference.terms), atol=1e-8)
    law = reference.law("filtered")
    np.testing.assert_allclose(run["mean"].values[1:, 0], law.mean[1:], atol=1e-7)


def test_a_fine_sensor_reads_the_density():
    """Between the points of the first segments, its likelihood is below any double."""
    mean, start = lambda x: x + 0.1 * np.log(x), lambda x: norm.pdf(x, 0.5, 0.3)
    reference = FixedNodes(edges(-3.0, 4.0, 0.08), mean, lambda x: 0.1, start, [None] * 3)
    before, density = reference.predicted_density[1:]
    log_density = np.log(density) + np.log(before @ reference.weights)  # what is not lost
    for sd in (1e-4, 1e-6, 1e-8):
        for d in (-0.4, 0.0, 0.1, 0.45, 1.2):
            i = np.argmin(np.abs(reference.x - d))
            (term,) = psf.log_likelihood(
                logarithmic(sensor=sd), psf.GridFilter(), {}, [reference.x[i]], steps=np.array([2])
            )
            np.testing.assert_allclose(term, log_density[i], rtol=0.0, atol=1e-6)


def test_a_fine_sensor_that_loses_the_sign_reads_both_densities():
    """Of the second peak no point has any mass beside the first."""
    model = psf.StateSpaceModel(
        lambda x, q: [x[0] + 0.1 * pt.log(x[0]) + q[0]],
        lambda x: [x[0] ** 2],
        process_noise=[[0.01]],
        observation_noise=lambda sd: [[sd**2]],
        initial_mean=[0.3],
        initial_cov=[[0.09]],
    )
    mean, start = lambda x: x + 0.1 * np.log(x), lambda x: norm.pdf(x, 0.3, 0.3)
    roots = np.array([0.2, 0.31, 0.4])
    ends = np.unique([*edges(-3.0, 4.0, 0.08), *-roots, *roots])
    at = FixedNodes(ends, mean, lambda x: 0.1, start, [None] * 3)
    before, density = at.predicted_density[1:]
    both = np.interp([-roots, roots], at.x, density).sum(axis=0) / (2.0 * roots)
    exact = np.log(both * (before @ at.weights))
    for sd in (1e-4, 1e-6):
        terms = [
            psf.log_likelihood(model, psf.GridFilter(), {"sd": sd}, [d], steps=np.array([2]))[0]
            for d in roots**2
        ]
        np.testing.assert_allclose(terms, exact, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("far", [30.0, 1e6])
def test_an_observation_beyond_what_doubles_hold_is_named(far):
    with pytest.warns(psf.errors.FilterWarning, match=Failure(TOO_FAR).message):
        terms = psf.log_likelihood(LOG, psf.GridFilter(), {}, [0.4, far, 0.3], steps=np.arange(3))
    assert np.isfinite(terms[0])
    assert (terms[1:] == -np.inf).all()


def test_a_sensor_may_have_kinks_and_jumps():
    """A detector that sees nothing below zero, and a limit of its range."""
    counts = np.array([2.0, 0.0, 7.0, 1.0])
    breaks = [*np.linspace(-8.0, 0.1 / 3.0, 60), *np.linspace(0.1 / 3.0, 5.0 / 3.0, 12)[1:]]
    reference = FixedNodes(
        [*breaks, *np.linspace(5.0 / 3.0, 9.0, 55)[1:]],
        lambda x: 0.8 * x,
        lambda x: 0.5,
        lambda x: norm.pdf(x, 0.5, 1.0),
        [counted(d, lambda x: np.clip(3.0 * x, 0.1, 5.0)) for d in counts],
    )
    terms = psf.log_likelihood(CLIPPED, psf.GridFilter(), {}, counts, steps=np.arange(4))
    np.testing.assert_allclose(terms, reference.terms, rtol=0.0, atol=1e-5)
