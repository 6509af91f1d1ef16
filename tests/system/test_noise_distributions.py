"""Competing exits of a compartment, and gamma white noise: moments, limits and bad input."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy import stats

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system import stationary

N_DRAWS = 200_000
RATES, DT, SIGMA = np.array([0.5, 0.0, 2.0]), 0.4, 0.3


def exits():
    """Three exits of x[0], and a factor of a rate, drawn together."""
    return psf.StateSpaceModel(
        transition=lambda x, q: q,
        process_dist=lambda x, a, b, c, sigma: [
            *psf.compartments.euler_multinomial(x[0], [a, b, c], DT),
            psf.compartments.gamma_white_noise(sigma, DT),
        ],
        observation=lambda x: x[0],
        observation_noise=1.0,
        initial_dist=lambda: [0, 0, 0, 0],
    )


SYSTEM = exits()


def drawn(system, size, rates, sigma=SIGMA, n=N_DRAWS, at=None):
    compiled = compile_system(system)
    X = np.zeros((4, n))
    X[0] = size
    normals = np.random.default_rng(1).normal(size=(compiled.m, n)) if at is None else at
    c = compiled.prepare.function(np.array([*rates, sigma]))
    compiled.propagate.function(c, np.zeros((1, 0)), 0, 0.0, normals, X)
    return X


def test_exits_have_mean_variance_and_covariance():
    found = drawn(SYSTEM, 50, RATES)[:3]
    leave = -np.expm1(-RATES.sum() * DT)
    shares = leave * RATES / RATES.sum()
    np.testing.assert_array_equal(found[1], 0.0)
    assert (found.sum(axis=0) <= 50).all()
    covariance = 50 * (np.diag(shares) - np.outer(shares, shares))
    error = np.sqrt(np.diag(covariance) / N_DRAWS)
    assert (np.abs(found.mean(axis=1) - 50 * shares) <= 5 * error).all()
    np.testing.assert_allclose(np.cov(found), covariance, atol=0.15)
    total = found.sum(axis=0)
    counts = [(total == k).sum() for k in range(20, 45)]
    assert stats.chisquare(
        np.r_[counts, N_DRAWS - sum(counts)],
        N_DRAWS * np.r_[p := stats.binom.pmf(range(20, 45), 50, leave), 1 - p.sum()],
    ).pvalue > 1e-4  # fmt: skip


def test_the_factor_has_mean_one_and_its_variance():
    factor = drawn(SYSTEM, 50, RATES)[3]
    variance = SIGMA**2 / DT
    assert abs(factor.mean() - 1.0) < 5 * np.sqrt(variance / N_DRAWS)
    assert factor.var() == pytest.approx(variance, rel=0.02)
    assert stats.kstest(factor, stats.gamma(1 / variance, scale=variance).cdf).pvalue > 1e-4


def test_without_rates_nobody_leaves_and_with_endless_ones_all_do():
    np.testing.assert_array_equal(drawn(SYSTEM, 50, [0.0, 0.0, 0.0], n=100)[:3], 0.0)
    endless = drawn(SYSTEM, 50, [1e6, 3e6, 0.0], n=1000)[:3]
    np.testing.assert_array_equal(endless.sum(axis=0), 50.0)
    assert endless[0].mean() == pytest.approx(12.5, abs=0.5)
    np.testing.assert_array_equal(drawn(SYSTEM, 0, RATES, n=100)[:3], 0.0)


@pytest.mark.parametrize("rates", [[-1.0, 0.0, 0.0], [3.0, -1.0, 1.0], [-2.0, 1.0, 0.5]])
def test_a_negative_rate_is_no_number(rates):
    assert np.isnan(drawn(SYSTEM, 50, rates, n=10)[:3]).any(axis=0).all()


def test_the_surrogate_has_the_same_moments():
    gaussian = SYSTEM.gaussian
    m = compile_system(gaussian).m
    leave = -np.expm1(-RATES.sum() * DT)
    shares = leave * RATES / RATES.sum()
    mean = drawn(gaussian, 50, RATES, n=1, at=np.zeros((m, 1)))[:, 0]
    np.testing.assert_allclose(mean, [*50 * shares, 1.0], rtol=1e-9)
    h = 1e-5
    jac = (drawn(gaussian, 50, RATES, n=m, at=h * np.eye(m)) - mean[:, None]) / h
    covariance = 50 * (np.diag(shares) - np.outer(shares, shares))
    np.testing.assert_allclose((jac @ jac.T)[:3, :3], covariance, atol=1e-3)
    assert (jac @ jac.T)[3, 3] == pytest.approx(SIGMA**2 / DT, rel=1e-4)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: psf.compartments.euler_multinomial(5, [], 0.1),
            "rates must be a list with the rate of each",
        ),
        (
            lambda: psf.compartments.euler_multinomial(5, 2.0, 0.1),
            "rates must be a list .* got 2.0",
        ),
        (
            lambda: psf.compartments.euler_multinomial(-5, [1.0], 0.1),
            "size of euler_multinomial must be at le",
        ),
        (
            lambda: psf.compartments.euler_multinomial(5, [-1.0], 0.1),
            "rates of euler_multinomial must be at",
        ),
        (lambda: psf.compartments.gamma_white_noise(0.0, 0.1), "sigma must be"),
        (lambda: psf.compartments.gamma_white_noise(1.0, -0.1), "dt must be"),
    ],
)
def test_numbers_that_cannot_be_are_refused(call, message):
    with pytest.raises(psf.errors.ModelError, match=message):
        call()


def test_exits_may_be_parameters_of_others():
    """Of those who leave, a share is counted."""
    system = psf.StateSpaceModel(
        transition=lambda x, q: [x[0] - q[0], q[1]],
        process_dist=lambda x: [
            (left := psf.compartments.euler_multinomial(x[0], [1.0], 0.5)[0]),
            pm.Binomial.dist(left, 0.5),
        ],
        observation_dist=lambda x: [pm.Poisson.dist(x[1] + 1.0)],
        initial_dist=lambda: [30, 0],
    )
    path = psf.simulate(system, {}, steps=range(5), random_seed=1)["states"].values
    assert (path[1:, 1] <= -np.diff(path[:, 0])).all()
    assert path[-1, 0] < 30


# The stationary distribution of a Markov chain.


def test_a_step_leaves_it_as_it_is():
    """Also with moves of probability zero."""
    P = np.array([[0.5, 0.5, 0.0], [0.0, 0.2, 0.8], [0.3, 0.0, 0.7]])
    pi = stationary(P).eval()
    np.testing.assert_allclose(pi @ P, pi, rtol=1e-14)
    np.testing.assert_allclose(pi.sum(), 1.0, rtol=1e-14)


def test_values_that_are_left_for_ever():
    """They have no mass, and a value that is never left has all of it."""
    np.testing.assert_allclose(stationary([[0.9, 0.1], [0.0, 1.0]]).eval(), [0, 1], atol=1e-290)
    P = [[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.3, 0.3, 0.4]]
    np.testing.assert_allclose(stationary(P).eval(), [0.5, 0.5, 0.0], rtol=1e-14)


def test_rare_moves():
    """Relative errors are those of the probabilities; differences would lose nine digits."""
    rare = 1e-9
    P = [[1 - rare, rare, 0.0], [rare, 1 - 3 * rare, 2 * rare], [0.0, rare, 1 - rare]]
    np.testing.assert_allclose(stationary(P).eval(), [0.25, 0.25, 0.5], rtol=1e-14)


def test_it_has_no_kinks():
    """A solution with pivots has them in the graph, so that three regimes would get no gradient."""
    system = psf.StateSpaceModel(
        transition=lambda x, q: [q[0]],
        process_dist=lambda x, P: [pm.Categorical.dist(P[pt.cast(x[0], "int64")])],
        observation_dist=lambda x: [pm.Poisson.dist(1.0 + x[0])],
        initial_dist=lambda P: [pm.Categorical.dist(stationary(P))],
        shapes={"P": (3, 3)},
    )
    assert psf.FiniteStateFilter().is_smooth_for(compile_system(system))


def test_other_shapes_are_refused():
    """By their shape."""
    with pytest.raises(ModelError, match=r"square matrix of static shape, got the shape \(2, 3\)"):
        stationary(np.zeros((2, 3)))
