"""Ten thousand million normals against the laws that they should have; `make test-slow`."""

import math

import numpy as np
import pytest
from numba import njit
from scipy import special, stats

from pymc_statespace_filters.compiler.numerics.normals import fill_normals
from pymc_statespace_filters.compiler.numerics.philox import PROCESS

pytestmark = pytest.mark.slow

MEMBERS, N_STEPS = 1280, 7_812_500  # together 1e10
BINS_PER_UNIT, REACH = 4096, 8
N_POWERS = 8


@njit
def tally(seed, n_steps, counts, sums):
    """Counts of the normals in bins, and sums of their powers, over steps."""
    Z = np.empty((1, MEMBERS))
    for step in range(n_steps):
        fill_normals(seed, PROCESS, step, Z)
        of_step = np.zeros(N_POWERS)
        for i in range(MEMBERS):
            z = Z[0, i]
            counts[int((z + REACH) * BINS_PER_UNIT)] += 1
            power = 1.0
            for p in range(N_POWERS):
                power *= z
                of_step[p] += power
        sums += of_step


@pytest.fixture(scope="module")
def tallied():
    counts, sums = np.zeros(2 * REACH * BINS_PER_UNIT, dtype=np.int64), np.zeros(N_POWERS)
    tally(2027, N_STEPS, counts, sums)
    return counts, sums


def test_moments_to_the_eighth(tallied):
    counts, sums = tallied
    n = counts.sum()
    moment = [0 if p % 2 else special.factorial2(p - 1) for p in range(1, 2 * N_POWERS + 1)]
    for p in range(1, N_POWERS + 1):
        variance = moment[2 * p - 1] - moment[p - 1] ** 2
        # eight moments within 4 standard errors: one false alarm in 2000 seeds
        assert abs(sums[p - 1] / n - moment[p - 1]) < 4 * math.sqrt(variance / n), p


def test_kolmogorov_smirnov(tallied):
    counts, _ = tallied
    n = counts.sum()
    edges = np.arange(1, counts.size + 1) / BINS_PER_UNIT - REACH
    distance = np.abs(np.cumsum(counts) / n - special.ndtr(edges)).max()
    # At 65 536 edges, which can only be less than the largest distance: one in 1000 at most.
    assert distance * math.sqrt(n) < stats.kstwobign.isf(1e-3)


def test_tails_to_six_standard_deviations(tallied):
    counts, _ = tallied
    n = counts.sum()
    for bound in (3, 4, 4.5, 5, 5.5, 6):
        edge = int(bound * BINS_PER_UNIT)
        middle = REACH * BINS_PER_UNIT
        for tail in (counts[middle + edge :].sum(), counts[: middle - edge].sum()):
            # two-sided Poisson probability: twelve tails, one false alarm in 1000 seeds
            expected = n * special.ndtr(-bound)
            beyond = min(stats.poisson.cdf(tail, expected), stats.poisson.sf(tail - 1, expected))
            assert 2 * beyond > 1e-3 / 12, (bound, tail, expected)


@njit
def products(n_steps, seed_a, step_a, row_a, lane_a, seed_b, step_b, row_b, lane_b):
    """Mean products of z, |z| and z^2 (centred, scaled) of numbers at two places."""
    A, B = np.empty((2, MEMBERS)), np.empty((2, MEMBERS))
    total = np.zeros((3, 3))
    u, v = np.empty(3), np.empty(3)
    mean_abs = math.sqrt(2 / math.pi)
    for step in range(n_steps):
        fill_normals(seed_a, PROCESS, 2 * step + step_a, A)
        fill_normals(seed_b, PROCESS, 2 * step + step_b, B)
        for i in range(MEMBERS - 64):
            a, b = A[row_a, i + lane_a], B[row_b, i + lane_b]
            u[0], u[1] = a, (abs(a) - mean_abs) / math.sqrt(1 - 2 / math.pi)
            v[0], v[1] = b, (abs(b) - mean_abs) / math.sqrt(1 - 2 / math.pi)
            u[2], v[2] = (a * a - 1) / math.sqrt(2), (b * b - 1) / math.sqrt(2)
            for p in range(3):
                for q in range(3):
                    total[p, q] += u[p] * v[q]
    return total


PLACES = {
    "members": ((5, 0, 0, 0), (5, 0, 0, 1)),
    "a call's members": ((5, 0, 0, 0), (5, 0, 0, 16)),
    "a pair's members": ((5, 0, 0, 0), (5, 0, 0, 32)),
    "blocks": ((5, 0, 0, 0), (5, 0, 0, 64)),
    "steps": ((5, 0, 0, 0), (5, 1, 0, 0)),
    "components": ((5, 0, 0, 0), (5, 0, 1, 0)),
    "seeds": ((5, 0, 0, 0), (6, 0, 0, 0)),
    "seeds far apart": ((5, 0, 0, 0), (5 + 2**32, 0, 0, 0)),
}


@pytest.mark.parametrize("places", PLACES.values(), ids=PLACES)
def test_neighbours_are_uncorrelated(places):
    n_steps = 100_000
    n = n_steps * (MEMBERS - 64)
    correlation = products(n_steps, *places[0], *places[1]) / n
    # 72 correlations in all, each within 4.2 sd: one false alarm in 500 seeds
    assert np.abs(correlation).max() < 4.2 / math.sqrt(n)
