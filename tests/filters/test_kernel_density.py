"""The kernel density against plain NumPy, in the bulk and far out in the tails."""

import numpy as np
import pytest
from numba import njit
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from pymc_statespace_filters.filters.ensemble.reductions import (
    RankLayout,
    local_partition,
    weighted_cov,
)
from pymc_statespace_filters.filters.kernel_density.density import (
    density_workspace,
    kernel_workspace,
    log_kernel_density,
    scott_bandwidth,
)
from tests.compiled import from_python

density_workspace, log_kernel_density, scott_bandwidth = map(
    from_python, (density_workspace, log_kernel_density, scott_bandwidth)
)

ALONE = RankLayout(0, 1, 0)


@njit(error_model="numpy", nogil=True)
def covariance(w, X, kernel, divisor, local):
    weighted_cov(w, X, kernel.mean, X, kernel.mean, divisor, local, kernel.cov)


def all_members(n_members, n):
    return local_partition.py_func(ALONE, n_members, n * n)


def bandwidth(X, w, free=None):
    n, N = X.shape
    free = np.arange(n) if free is None else np.array(free)
    local, kernel = all_members(N, n), kernel_workspace.py_func(n, free.size)
    kernel.mean[:] = np.where(w > 0, X, 0) @ w
    covariance(w, X, kernel, 1 - w @ w, local)
    ok = scott_bandwidth(1 / (w @ w), free, kernel)
    return ok, kernel, free


def log_density(X, w, V, free=None):
    ok, kernel, free = bandwidth(X, w, free)
    assert ok
    out, local = np.full(w.size, np.nan), all_members(w.size, 1)
    work = density_workspace(local, free.size)
    log_kernel_density(local, w, X, V, free, kernel, work, out)
    return out


def oracle(X, w, V):
    """Log-density by a double loop over SciPy's normal density, Eqs. 4.38-4.39 written out."""
    n = X.shape[0]
    centred = X - (X @ w)[:, None]
    cov = (w * centred) @ centred.T / (1 - np.sum(w**2))
    kernel_cov = cov * (1 / np.sum(w**2)) ** (-2 / (n + 4))
    kernel = multivariate_normal(np.zeros(n), kernel_cov)
    differences = V.T[:, None, :] - X.T[None, :, :]
    with np.errstate(divide="ignore"):
        return logsumexp(kernel.logpdf(differences) + np.log(w), axis=1)


def weighted_particles(n, n_particles, seed):
    rng = np.random.default_rng(seed)
    mix = rng.standard_normal((n, n)) + 2 * np.eye(n)
    X = mix @ rng.standard_normal((n, n_particles)) + 5
    w = rng.dirichlet(np.full(n_particles, 0.5))
    return rng, X, w


@pytest.mark.parametrize("n_particles", [2, 64, 65, 200])
@pytest.mark.parametrize("n", [1, 2, 3])
def test_equals_the_double_loop(n, n_particles):
    rng, X, w = weighted_particles(n, max(n_particles, n + 2), seed=n)
    V = X + rng.standard_normal(X.shape)
    assert log_density(X, w, V) == pytest.approx(oracle(X, w, V), rel=1e-10)


@pytest.mark.parametrize("distance", [1e1, 1e2, 1e4, 1e8])
@pytest.mark.parametrize("n", [1, 2])
def test_tails_far_beyond_underflow_are_finite_and_right(n, distance):
    _, X, w = weighted_particles(n, 100, seed=3)
    V = X + distance
    out = log_density(X, w, V)
    assert out.max() < -100 or distance < 1e2
    assert out == pytest.approx(oracle(X, w, V), rel=1e-10)


def test_extremely_uneven_weights_with_zeros_and_dead_members():
    _, X, _ = weighted_particles(2, 120, seed=5)
    w = np.exp(-np.linspace(0, 600, 120))
    w[50:] = 0
    w /= w.sum()
    expected = oracle(X, w, X)
    X_dead = X.copy()
    X_dead[:, 60:70] = np.nan
    X_dead[0, 70:80] = np.inf
    out = log_density(X_dead, w, X_dead)
    alive = np.isfinite(X_dead).all(axis=0)
    assert out[alive] == pytest.approx(expected[alive], rel=1e-10)
    assert np.all(out[~alive] == -np.inf)


def test_integrates_to_one():
    _, X, w = weighted_particles(1, 400, seed=6)
    grid = np.linspace(X.min() - 10, X.max() + 10, 400)[None]
    assert np.trapezoid(np.exp(log_density(X, w, grid)), grid[0]) == pytest.approx(1, abs=1e-6)


def test_carried_states_are_not_part_of_the_density():
    _, X, w = weighted_particles(2, 80, seed=7)
    with_branch = np.stack([X[0], np.sign(X[1]), X[1]])
    out = log_density(with_branch, w, with_branch, free=[0, 2])
    assert out == pytest.approx(oracle(X, w, X), rel=1e-10)


@pytest.mark.parametrize("constant", [0.0, 1e6, -1 / 3])
def test_a_state_known_exactly_is_left_out(constant):
    _, X, w = weighted_particles(2, 90, seed=8)
    with_constant = np.stack([X[0], np.full(90, constant), X[1]])
    _, kernel, _ = bandwidth(with_constant, w)
    assert kernel.active.tolist() == [True, False, True]
    out = log_density(with_constant, w, with_constant)
    assert out == pytest.approx(oracle(X, w, X), rel=1e-10)


def test_a_copy_of_another_state_is_left_out():
    _, X, w = weighted_particles(1, 90, seed=9)
    _, kernel, _ = bandwidth(np.concatenate([X, -3 * X]), w)
    assert kernel.active.tolist() == [True, False]


def test_no_spread_at_all_leaves_a_density_of_one():
    w = np.full(10, 0.1)
    assert np.allclose(log_density(np.full((2, 10), 3.0), w, np.full((2, 10), 3.0)), 0)


def test_moments_that_are_not_finite_are_refused():
    w = np.full(10, 0.1)
    X = np.linspace(-1e200, 1e200, 10)[None]
    assert not bandwidth(X, w)[0]


@pytest.mark.parametrize("n_particles", [30, 300])
@pytest.mark.parametrize("n", [1, 2])
def test_how_far_the_particles_are_from_zero_makes_no_difference(n, n_particles):
    _, X, w = weighted_particles(n, n_particles, seed=4)
    X = np.round(X * 2**20) / 2**20  # so that a large power of two is added without rounding
    V = 3 * X
    near, far = log_density(X, w, V), log_density(X + 2.0**30, w, V + 2.0**30)
    # the moments are rounded, at 1e-16 of the distance: 1e-7 of a bandwidth; the tails feel it
    assert far[:5] == pytest.approx(near[:5], rel=1e-5)
    assert np.abs(far - near).max() < 1e-5 * np.abs(near).max()
