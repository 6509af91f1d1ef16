"""Kernel densities through the grid, against plain exact sums, target by target.

The error is that of the density itself, |f / exact - 1|, wherever the target is.
"""

import numpy as np
import pytest
from numba import njit
from scipy.special import logsumexp

from pymc_statespace_filters.compiler.numerics.normals import padded
from pymc_statespace_filters.filters.ensemble.reductions import RankLayout
from pymc_statespace_filters.filters.kernel_density.density import density_method
from pymc_statespace_filters.filters.kernel_density.direct_sum import Points
from pymc_statespace_filters.filters.kernel_density.gridded_sum import (
    FLOOR,
    gridded_sum_workspace,
    gridded_sums,
)
from pymc_statespace_filters.filters.pf_enkf import PFEnKF
from tests.compiled import from_python
from tests.filters.ensemble_contract import LINE, OSCILLATOR, run
from tests.filters.test_kernel_density import bandwidth, log_density
from tests.filters.test_pf_enkf_page import numpy_pf_enkf

gridded_sum_workspace = from_python(gridded_sum_workspace)

GOAL = 1e-8
REACHED = 2e-9  # what the module promises of a pair, and a little for what windows leave out


@njit
def _sums(sources, targets, work):
    layout, n_members, n_dims = RankLayout(0, 1, 0), sources.shape[1], sources.shape[0] - 1
    sources, targets = Points(sources, n_members, True), Points(targets, n_members, True)
    return gridded_sums(layout, sources, targets, n_dims, work)


def sums(w, Y, V):
    """The gridded sums alone: whether they were used, and their values, in units of the kernel."""
    return gridded(w, Y, V, gridded_sum_workspace(1, padded(w.size)))


def gridded(w, Y, V, work):
    sources, targets = np.vstack([w, Y / np.sqrt(2)]), np.vstack([w, V / np.sqrt(2)])
    return _sums(sources, targets, work), targets[0]


def exact(X, w, V, H):
    """Log-density at the columns of V; members of zero weight are left out."""
    alive = w > 0
    Y, V = np.linalg.solve(H, X[:, alive]), np.linalg.solve(H, V)
    exponents = -0.5 * ((V[:, :, None] - Y[:, None, :]) ** 2).sum(axis=0)
    constant = np.log(np.diag(H)).sum() + 0.5 * len(H) * np.log(2 * np.pi)
    return logsumexp(exponents + np.log(w[alive]), axis=1) - constant


def errors(X, w, V, check=slice(None)):
    H = bandwidth(X, w)[1].H
    return np.abs(np.expm1(log_density(X, w, V)[check] - exact(X, w, V[:, check], H)))


def cloud(n, N, seed=0):
    rng = np.random.default_rng(seed)
    mix = rng.standard_normal((n, n)) + 2 * np.eye(n)
    return rng, mix @ rng.standard_normal((n, N)) + 5, np.full(N, 1 / N)


@pytest.mark.parametrize("n", [1, 2])
def test_every_pair_has_the_same_relative_error(n):
    # One member, and targets around it at all phases of the grid, down to the floor
    rng = np.random.default_rng(1)
    N = 4000
    Y = np.repeat(rng.standard_normal((n, 1)), N, axis=1)
    w = np.where(np.arange(N) == 17, 1.0, 0.0)
    direction = rng.standard_normal((n, N))
    V = Y + direction / np.linalg.norm(direction, axis=0) * np.linspace(0, 5.2, N)
    used, f = sums(w, Y, V)
    truth = np.exp(-0.5 * ((V - Y) ** 2).sum(axis=0))
    assert used
    assert truth.min() < 2 * FLOOR
    assert np.abs(f / truth - 1).max() < {1: 5.1e-10, 2: 1.1e-9}[n]


def test_a_plain_interpolation_would_not_pass():
    # Where the density falls to a fifth from one grid point to the next
    N = 1000
    Y, V = np.zeros((1, N)), np.linspace(-12, -10, N)[None]
    V[:, ::2] = np.linspace(4, 5, N // 2)
    used, f = sums(np.full(N, 1 / N), Y, V)
    near = V[0] > 0
    assert used
    assert np.abs(f[near] / np.exp(-0.5 * V[0, near] ** 2) - 1).max() < REACHED
    assert f[~near].max() < FLOOR


@pytest.mark.parametrize("N", [2, 5, 63, 64, 255, 256, 257, 1000, 4000, 16000])
@pytest.mark.parametrize("n", [1, 2])
def test_any_number_of_particles(n, N):
    rng, X, w = cloud(n, max(N, n + 1))
    check = slice(None, None, max(1, N // 200))
    assert errors(X, w, X, check).max() < REACHED
    w = rng.dirichlet(np.full(w.size, 0.5))
    assert errors(X, w, X + 0.3 * rng.standard_normal(X.shape), check).max() < REACHED


@pytest.mark.parametrize("bandwidths", [5, 10, 20])
@pytest.mark.parametrize("n", [1, 2])
def test_targets_outside_the_cloud(n, bandwidths):
    _, X, w = cloud(n, 1000)
    H = bandwidth(X, w)[1].H
    V = X.copy()
    V[:, ::3] = X.max(axis=1)[:, None] + bandwidths * H.sum(axis=1)[:, None]
    assert errors(X, w, V).max() < REACHED


@pytest.mark.parametrize("n", [1, 2])
def test_extremely_uneven_weights(n):
    rng, X, w = cloud(n, 1000)
    w[::2] = 1e-300
    assert errors(X, w / w.sum(), X).max() < REACHED
    w = np.exp(-np.linspace(0, 690, 1000))
    w /= w.sum()
    order = rng.permutation(1000)
    assert errors(X, w[order], X).max() < REACHED
    w[5:] = 0
    assert errors(X, w[order] / w.sum(), X).max() < REACHED


@pytest.mark.parametrize("n", [1, 2])
def test_two_modes_far_apart_and_coincident_members(n):
    _, X, w = cloud(n, 1000)
    X[:, ::2] = 0.05 * X[:, ::2] + 1e3
    assert errors(X, w, X).max() < REACHED
    X[:, 300:] = X[:, :1]
    assert errors(X, w, X).max() < REACHED


@pytest.mark.parametrize("n", [1, 2])
def test_one_far_outlier(n):
    _, X, w = cloud(n, 1000)
    X[:, 7] = 1e6
    assert errors(X, w, X).max() < REACHED
    V = X.copy()
    V[:, 7], X[:, 7] = -1e9, 0.0
    assert errors(X, w, V, np.arange(1000) != 7).max() < REACHED


@pytest.mark.parametrize("n", [1, 2])
def test_dead_members_and_targets(n):
    _, X, w = cloud(n, 1000)
    w[100:] = 0
    w /= w.sum()
    dead = X.copy()
    dead[:, 200:300], dead[0, 300:350], dead[0, 350:400] = np.nan, np.inf, -np.inf
    H = bandwidth(X, w)[1].H
    out = log_density(dead, w, dead)
    alive = np.isfinite(dead).all(axis=0)
    assert np.all(out[~alive] == -np.inf)
    assert np.abs(np.expm1(out[alive] - exact(X, w, X, H)[alive])).max() < REACHED


@pytest.mark.parametrize("n", [1, 2])
@pytest.mark.parametrize("bandwidths", [5, 10, 20, 100])
def test_all_targets_outside_the_cloud(n, bandwidths):
    # A surprising observation of a precise sensor: particles in a small heap, far from the forecast
    rng, X, _ = cloud(n, 1000)
    w = rng.dirichlet(np.full(1000, 0.5))
    H = bandwidth(X, w)[1].H
    for spread in (1e-3, 1.0, 10.0):
        V = X.max(axis=1)[:, None] + H @ (bandwidths + spread * rng.standard_normal(X.shape))
        V[0, 5] = np.nan
        assert errors(X, w, V, np.arange(1000) != 5).max() < REACHED
        assert log_density(X, w, V)[5] == -np.inf


@pytest.mark.parametrize("n", [1, 2])
def test_no_target_near_any_member(n):
    _, X, w = cloud(n, 300)
    V = X + 1e3
    assert not sums(w, X, V)[1].any()
    assert errors(X, w, V).max() < GOAL  # the sums are exact, their exponents of order 1e6


def test_a_grid_that_would_be_too_large_is_refused():
    _, X, w = cloud(2, 300)
    assert sums(w, X, X)[0]
    assert not sums(w, 100 * X, 100 * X)[0]


def test_workspace_can_change_from_two_directions_to_one():
    _, X, w = cloud(2, 400)
    work = gridded_sum_workspace(1, padded(400))
    assert gridded(w, X, X, work)[0]
    used, second = gridded(w, X[:1], X[:1], work)
    assert used
    assert np.array_equal(second, sums(w, X[:1], X[:1])[1])


def test_the_method_is_reported():
    assert density_method(1, 1000) == density_method(2, 1250) == "lattice"
    assert density_method(1, 30) == density_method(2, 100) == density_method(3, 10**5) == "exact"
    assert density_method(0, 1000) == "exact"


@pytest.mark.parametrize(
    ("record", "resample_below"), [(LINE, 0), (OSCILLATOR, 0.9)], ids=["line", "plane"]
)
def test_log_likelihood_of_the_filter_per_observation(record, resample_below):
    # NumPy's filter sums exactly; its ancestors are the same
    n_particles = 300
    filter_ = PFEnKF(n_particles, likelihood="weights", resample_below=resample_below)
    assert density_method(len(record[0].A), n_particles) == "lattice"
    expected = numpy_pf_enkf(*record, n_particles, 0, "weights", resample_below)
    terms, _ = run(filter_, *record, seed=0)
    assert np.abs(terms - expected).max() < 1e-6
