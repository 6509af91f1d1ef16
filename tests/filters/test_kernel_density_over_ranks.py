"""Kernel densities over ranks: the same to the bit as by one, whatever the targets are."""

import numpy as np
import pytest

from pymc_statespace_filters.compiler.numerics.normals import padded
from pymc_statespace_filters.filters.ensemble.reductions import RankLayout, local_partition
from pymc_statespace_filters.filters.kernel_density.density import (
    density_workspace,
    log_kernel_density,
)
from tests.compiled import from_python
from tests.filters.test_kernel_density import bandwidth, weighted_particles
from tests.ranks import on_ranks

density_workspace, log_kernel_density = map(from_python, (density_workspace, log_kernel_density))

LINE, PLANE, SPACE = 1, 2, 3


def densities(size, X, w, V, kernel):
    """Log-densities by so many ranks, and the columns of all arrays that the first completed."""
    n, N = X.shape
    free = np.arange(n)

    def call(rank):
        local = local_partition.py_func(RankLayout(rank.rank, size, rank.exchange), N, 1)
        columns = slice(local.first, local.first + local.size)
        work = density_workspace(local, n)
        for scratch in (work[0].rows, work[1].rows):
            scratch[:] = np.nan  # what a rank is not told it does not know
        out = np.empty(local.size)
        own_w, own_X, own_V = (np.ascontiguousarray(A[..., columns]) for A in (w, X, V))
        log_kernel_density(local, own_w, own_X, own_V, free, kernel, work, out)
        return out, [n_columns for _, n_columns, _ in rank.exchanged]

    results = on_ranks(size, call)
    return np.concatenate([out for out, _ in results]), results[0][1]


def assert_same(X, w, V, sizes=(2, 3, 4)):
    _, kernel, _ = bandwidth(X, w)
    alone, exchanged = densities(1, X, w, V, kernel)
    assert exchanged == []
    for size in sizes:
        assert np.array_equal(densities(size, X, w, V, kernel)[0], alone, equal_nan=True)
    return alone


@pytest.mark.parametrize("N", [193, 300, 1000])
@pytest.mark.parametrize("n", [LINE, PLANE, SPACE])
def test_exact_sums_and_grids(n, N):
    rng, X, w = weighted_particles(n, N, seed=n)
    assert np.all(np.isfinite(assert_same(X, w, X + 0.3 * rng.standard_normal(X.shape))))


@pytest.mark.parametrize("n", [LINE, PLANE])
def test_one_grid_for_each_stretch_of_many_members(n):
    rng, X, w = weighted_particles(n, 9000, seed=2)
    assert_same(X, w, X + 0.1 * rng.standard_normal(X.shape))


@pytest.mark.parametrize("n", [LINE, PLANE])
def test_members_stay_where_they_are_if_each_rank_has_grids_of_its_own(n):
    _, X, w = weighted_particles(n, 9000, seed=2)
    _, kernel, _ = bandwidth(X, w)
    V = 0.9 * X + 0.5  # in the bulk
    assert padded(9000) not in densities(2, X, w, V, kernel)[1]
    assert padded(9000) in densities(3, X, w, V, kernel)[1]


@pytest.mark.parametrize(
    "targets", [slice(0, 20), slice(70, 100), slice(64, 192), slice(930, None)]
)
@pytest.mark.parametrize("n", [LINE, PLANE])
def test_tails_of_one_rank_alone(n, targets):
    # fewer targets than are worth a grid, more, and those of a block that is not full
    _, X, w = weighted_particles(n, 1000, seed=3)
    V = X.copy()
    V[:, targets] += 40
    assert assert_same(X, w, V)[targets].max() < -20


@pytest.mark.parametrize("distance", [30, 300])
@pytest.mark.parametrize("n", [LINE, PLANE])
def test_all_targets_in_the_tails(n, distance):
    rng, X, w = weighted_particles(n, 1000, seed=4)
    V = X + distance
    V[:, ::9] += 0.5 * distance * rng.standard_normal(V[:, ::9].shape)
    V[0, 100:170] = np.nan
    assert np.all(assert_same(X, w, V)[100:170] == -np.inf)


@pytest.mark.parametrize("n", [LINE, PLANE, SPACE])
def test_ranks_without_any_weight_or_finite_target(n):
    _, X, w = weighted_particles(n, 1000, seed=5)
    w[:520] = 0
    V = X.copy()
    X[:, :500], V[:, 400:] = np.nan, np.inf
    out = assert_same(X, w / w.sum(), V)
    assert np.all(np.isfinite(out[:400]))
    assert np.all(out[400:] == -np.inf)


def test_a_grid_that_would_be_too_large():
    _, X, w = weighted_particles(PLANE, 300, seed=6)
    w[7] = 1e-20
    X[:, 7] = 1e5
    V = X.copy()
    assert np.all(np.isfinite(assert_same(X, w / w.sum(), V)))


def test_no_direction_with_spread():
    X, w = np.full((2, 200), 3.0), np.full(200, 1 / 200)
    assert np.allclose(assert_same(X, w, X), 0)
