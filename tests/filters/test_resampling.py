"""Resampling: exact ancestors at given points, and the right law of the points."""

import numpy as np
import pytest
from scipy import stats

from pymc_statespace_filters.compiler.numerics.normals import BLOCK, fill_normals, padded
from pymc_statespace_filters.compiler.numerics.philox import RESAMPLING
from pymc_statespace_filters.filters.ensemble.resampling import (
    POINTS,
    choose_ancestors,
    choose_in_order,
    copy_ancestors,
    multinomial,
    n_normals,
    systematic,
)
from tests.compiled import from_python

choose_ancestors, choose_in_order, copy_ancestors, multinomial, systematic = map(
    from_python, (choose_ancestors, choose_in_order, copy_ancestors, multinomial, systematic)
)
points_of = {scheme: from_python(function) for scheme, function in POINTS.items()}


def ancestors_at(weights, points):
    out = np.full(len(points), -1)
    w = np.array(weights, dtype=float)
    choose_ancestors(w, np.array(points), np.empty(n_blocks(w)), out)
    return out.tolist()


def n_blocks(w):
    return padded(w.size) // BLOCK


def normals_of(scheme, n_particles, seed, step):
    Z = np.empty((1, n_normals(scheme, n_particles)))
    fill_normals(seed, RESAMPLING, step, Z)
    return Z[0]


def draw(scheme, weights, seed, step=0):
    w = np.array(weights, dtype=float)
    points, out = np.empty(w.size + 1), np.empty(w.size, dtype=np.int64)
    points_of[scheme](normals_of(scheme, w.size, seed, step), points)
    choose_ancestors(w, points, np.empty(n_blocks(w)), out)
    return out


def test_ancestor_is_the_particle_whose_interval_holds_the_point():
    # v = 0.1, 0.3, 0.6, 1.0 in binary-exact eighths: 1/8, 3/8, 5/8, 1
    weights = [0.125, 0.25, 0.25, 0.375]
    points = [0.0, 0.12, 0.125, 0.37, 0.375, 0.6, 0.625, 0.999]
    assert ancestors_at(weights, points) == [0, 0, 1, 1, 2, 2, 3, 3]


def test_first_and_last_particle_can_be_chosen_and_none_beyond():
    assert ancestors_at([0.25] * 4, [1e-300, np.nextafter(1, 0)]) == [0, 3]
    assert ancestors_at([0.25] * 4, [1.0]) == [3]


def test_zero_weights_are_never_chosen_not_even_at_the_ends():
    weights = [0.0, 0.5, 0.0, 0.5, 0.0, 0.0]
    points = np.sort(np.concatenate([[0.0, 0.5, 1.0], np.random.default_rng(0).uniform(size=100)]))
    assert set(ancestors_at(weights, points)) == {1, 3}


def test_ancestors_are_those_of_exact_sums_in_any_part_of_the_points():
    """Weights that are multiples of 2^-k, so that no sum is rounded; whole blocks without any."""
    rng = np.random.default_rng(4)
    for n in (64, 65, 127, 500, 1000):
        counts = rng.multinomial(2**20, rng.dirichlet(np.full(n, 0.05)))
        counts[-70:-3] = 0
        w = counts / 2.0**20
        points = np.sort(rng.uniform(size=n))
        expected = np.searchsorted(np.cumsum(w), points * w.sum(), side="right")
        for first in (0, n // 3, n - 1):
            assert ancestors_at(w, points[first:]) == expected[first:].tolist()
        assert ancestors_at(w, [1.0]) == [np.flatnonzero(w)[-1]]


def test_all_weight_on_one_particle():
    for where in range(3):
        weights = np.zeros(3)
        weights[where] = 1.0
        for scheme in POINTS:
            assert draw(scheme, weights, seed=2).tolist() == [where] * 3


def test_rounding_of_the_total_does_not_shift_the_end():
    weights = np.full(10, 0.1)  # adds up to 0.9999999999999999
    assert ancestors_at(weights, [np.nextafter(1, 0)]) == [9]


def test_systematic_counts_are_the_floor_or_ceiling_of_what_is_expected():
    rng = np.random.default_rng(1)
    for seed in range(50):
        w = rng.dirichlet(np.full(37, 0.3))
        counts = np.bincount(draw("systematic", w, seed), minlength=37)
        assert counts.sum() == 37
        assert np.all(np.abs(counts - 37 * w) < 1 + 1e-9)


def test_equal_weights_are_a_no_op_under_systematic_resampling():
    for seed in range(20):
        assert draw("systematic", np.full(64, 1 / 64), seed).tolist() == list(range(64))


@pytest.mark.parametrize("scheme", POINTS)
def test_expected_counts_are_n_times_the_weights(scheme):
    w, n_seeds = np.array([0.05, 0.0, 0.4, 0.25, 0.3]), 8000
    counts = sum(np.bincount(draw(scheme, w, seed), minlength=5) for seed in range(n_seeds))
    # each mean count has sd at most sqrt(5/4 / 8000); 4 sd: one false alarm in 3000 seeds
    assert counts[1] == 0
    assert np.all(np.abs(counts / n_seeds - 5 * w) < 4 * np.sqrt(1.25 / n_seeds))


def test_multinomial_counts_have_the_multinomial_variance():
    w, n_seeds = np.array([0.1, 0.2, 0.3, 0.4]), 4000
    counts = np.array([np.bincount(draw("multinomial", w, s), minlength=4) for s in range(n_seeds)])
    # sample variances of bounded counts: relative sd about sqrt(2 / 4000); 5 sd
    assert counts.var(axis=0) == pytest.approx(4 * w * (1 - w), rel=5 * np.sqrt(2 / n_seeds))


def test_multinomial_points_are_sorted_uniforms():
    points = np.empty(5001)
    multinomial(normals_of("multinomial", 5000, 3, 0), points)
    assert np.all(np.diff(points[:5000]) >= 0)
    assert stats.kstest(points[:5000], "uniform").pvalue > 1e-3
    spacings = np.diff(points[:5000]) * 5001  # the gaps of sorted uniforms are exponential
    assert stats.kstest(spacings, "expon").pvalue > 1e-3


def test_systematic_points_share_one_offset_which_is_uniform_over_seeds_and_steps():
    points, offsets = np.empty(9), []
    for seed in range(30):
        for step in range(30):
            systematic(normals_of("systematic", 8, seed, step), points)
            offsets.append(points[0] * 8)
            assert np.allclose(np.diff(points[:8]), 1 / 8)
    assert stats.kstest(offsets, "uniform").pvalue > 1e-3


def test_columns_are_copied_from_their_ancestors():
    X = np.arange(12.0).reshape(2, 6)
    ancestors, out = np.array([0, 0, 3, 3, 5, 5]), np.empty_like(X)
    copy_ancestors(X, ancestors, out)
    assert np.array_equal(out, X[:, ancestors])


def test_on_a_walk_in_order_ancestors_are_those_of_the_sorted_particles():
    rng = np.random.default_rng(8)
    x, w = rng.standard_normal(40), rng.dirichlet(np.full(40, 0.3))
    order = np.argsort(x)
    points, out = np.empty(41), np.empty(40, dtype=np.int64)
    systematic(normals_of("sorted", 40, 5, 0), points)
    choose_in_order(w, order, points, np.empty(40), np.empty(1), out)
    cumulative = np.cumsum(w[order])
    expected = order[np.searchsorted(cumulative, points[:40] * cumulative[-1], side="right")]
    assert np.array_equal(out, expected)
    assert np.all(np.diff(x[out]) >= 0)
