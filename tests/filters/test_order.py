"""The order of particles: a Hilbert curve on every grid, the sorted states of one direction."""

import numba
import numpy as np
import pytest

from pymc_statespace_filters.filters.ensemble.hilbert_sort import (
    order_particles,
    order_workspace,
    read_keys,
    undo_rotations,
)
from tests.compiled import from_python

order_particles, order_workspace, read_keys, undo_rotations = map(
    from_python, (order_particles, order_workspace, read_keys, undo_rotations)
)

workspace = numba.njit(lambda n, n_particles: order_workspace(n, n_particles))


def order_of(X, w=None):
    X = np.atleast_2d(np.asarray(X, dtype=float))
    N = X.shape[1]
    w = np.full(N, 1 / N) if w is None else np.asarray(w, dtype=float)
    return order_particles(w, X, workspace(X.shape[0], N))


@pytest.mark.parametrize(("n", "n_bits"), [(2, 6), (3, 4), (4, 3), (5, 2), (8, 1), (8, 2)])
def test_the_curve_visits_every_cell_once_and_goes_from_neighbour_to_neighbour(n, n_bits):
    side = 1 << n_bits
    cells = np.indices((side,) * n).reshape(n, -1).astype(np.int64)
    rotated, keys = cells.copy(), np.empty(cells.shape[1], np.int64)
    undo_rotations(rotated, n_bits)
    read_keys(rotated, n_bits, keys)
    assert np.array_equal(np.sort(keys), np.arange(keys.size))
    path = cells[:, np.argsort(keys)]
    assert np.all(np.abs(np.diff(path)).sum(axis=0) == 1)
    assert np.all(path[:, 0] == 0)


@pytest.mark.parametrize("n_bits", [2, 3])
def test_the_curve_fills_one_cell_of_each_coarser_grid_before_the_next(n_bits):
    """What tells Hilbert's curve from a snake through the rows."""
    side = 1 << n_bits
    cells = np.indices((side,) * 3).reshape(3, -1).astype(np.int64)
    rotated, keys = cells.copy(), np.empty(cells.shape[1], np.int64)
    undo_rotations(rotated, n_bits)
    read_keys(rotated, n_bits, keys)
    coarse = (cells >> 1)[:, np.argsort(keys)].reshape(3, -1, 8)
    assert np.all(coarse == coarse[:, :, :1])


@pytest.mark.parametrize("scale", [1e-100, 1.0, 1e100])
def test_one_direction_is_sorted_by_the_state(scale):
    rng = np.random.default_rng(2)
    x = scale * rng.standard_t(3, size=777)
    w = rng.dirichlet(np.ones(777))
    assert np.array_equal(order_of(x, w), np.argsort(x, kind="stable"))
    assert np.array_equal(order_of([np.full(777, 3.7), x], w), np.argsort(x, kind="stable"))


def test_equal_particles_keep_their_order():
    assert order_of(np.full((3, 100), 0.1)).tolist() == list(range(100))
    assert order_of([1.0, 0.0, 1.0, 0.0, 1.0]).tolist() == [1, 3, 0, 2, 4]


@pytest.mark.parametrize("n", [1, 2, 8])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308])
def test_particles_without_weight_do_not_touch_the_order_of_the_others(n, value):
    rng = np.random.default_rng(n)
    X, w = rng.standard_normal((n, 200)), np.full(200, 1 / 150)
    lost = rng.permutation(200)[:50]
    w[lost] = 0.0
    X[:, lost] = value
    order = order_of(X, w)
    assert np.array_equal(np.sort(order), np.arange(200))
    left = np.flatnonzero(w)
    assert np.array_equal(order[np.isin(order, left)], left[order_of(X[:, left], w[left])])


def test_states_too_large_to_square_break_nothing():
    X = np.array([[1e308, -1e308, 1e200, 0.0], [1.0, 2.0, 3.0, 4.0]])
    assert sorted(order_of(X)) == [0, 1, 2, 3]


@pytest.mark.parametrize("n", [2, 3, 8])
def test_neighbours_in_the_order_are_near(n):
    """Mean step along the order, in mean distances of two particles; any other order has 1."""
    N = 4096
    X = np.random.default_rng(5).standard_normal((n, N))
    path = X[:, order_of(X)]
    step = np.linalg.norm(np.diff(path), axis=0).mean()
    any_two = np.linalg.norm(X[:, 1:] - X[:, :-1], axis=0).mean()
    assert step < {2: 0.06, 3: 0.2, 8: 0.6}[n] * any_two


def test_units_do_not_matter():
    X = np.random.default_rng(6).standard_normal((3, 500))
    scaled = np.array([[2.0**20], [1.0], [2.0**-30]]) * X  # powers of two: no rounding
    assert np.array_equal(order_of(X), order_of(scaled))
