"""The test of a bound by unbiased estimates: its level at any tails, and what it sees."""

from itertools import product

import numpy as np
import pytest
from scipy.stats import binom

from pymc_statespace_filters.checks.filters.e_values import (
    log_e_values,
    proved_shortfall,
    visible_shortfall,
)

ALPHA, N_RUNS = 0.05, 2000


@pytest.mark.parametrize(("low", "high"), [(0.0, 40.0), (0.5, 3.0), (0.9, 1e6)])
def test_an_e_value_has_mean_one_at_the_bound(low, high):
    """All outcomes of four estimates that take two values, of mean one."""
    p = (1.0 - low) / (high - low)  # of the higher value
    mean = 0.0
    for outcome in product((0, 1), repeat=4):
        with np.errstate(divide="ignore"):
            logs = np.log([high if one else low for one in outcome])
        weight = np.prod([p if one else 1.0 - p for one in outcome])
        mean += weight * np.exp(log_e_values(logs[None])[0])
    assert mean == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("scatter", [0.3, 1.0, 3.0, 8.0])
@pytest.mark.parametrize("n_points", [1, 10])
def test_a_bound_that_holds_is_rejected_with_probability_alpha_at_most(scatter, n_points):
    rng = np.random.default_rng(1)
    logs = rng.normal(-(scatter**2) / 2, scatter, (N_RUNS, n_points, 4))
    e_values = np.exp(log_e_values(logs.reshape(-1, 4))).reshape(N_RUNS, n_points)
    rejected = e_values.mean(axis=1) > 1.0 / ALPHA
    # One in a million runs of this test would exceed this, at a rate of alpha.
    assert rejected.sum() <= binom.isf(1e-6, N_RUNS, ALPHA)
    chosen = [*range(10), *np.flatnonzero(rejected)[:3]]
    for i in chosen:
        assert (proved_shortfall(logs[i], np.zeros(n_points), ALPHA) > 0.0) == rejected[i]


def test_what_is_proved_is_close_to_the_shortfall_where_estimates_are_quiet():
    rng = np.random.default_rng(2)
    for true in (3.0, 30.0, 3000.0):
        logs = rng.normal(true - 0.005, 0.1, (10, 4))
        assert true - 2.5 < proved_shortfall(logs, np.zeros(10), ALPHA) < true


def test_one_estimate_in_many_proves_a_large_shortfall():
    logs = np.full((10, 4), -50.0)
    logs[3, 2] = 30.0
    assert 20.0 < proved_shortfall(logs, np.zeros(10), ALPHA) < 30.0


def test_a_single_point_that_is_low_is_found_among_others():
    logs = np.zeros((10, 4))
    logs[7] = 5.0
    assert 2.0 < proved_shortfall(logs, np.zeros(10), ALPHA) < 5.0


def test_failures_prove_nothing():
    assert proved_shortfall(np.full((3, 4), -np.inf), np.zeros(3), ALPHA) == -np.inf
    assert visible_shortfall(np.full((3, 4), -np.inf), np.zeros(3), ALPHA) == np.inf


def test_what_would_have_been_seen_is_seen():
    rng = np.random.default_rng(3)
    for scatter in (0.1, 0.5, 1.0):
        logs = rng.normal(-(scatter**2) / 2, scatter, (10, 4))
        visible = visible_shortfall(logs, np.zeros(10), ALPHA)
        found = [
            proved_shortfall(
                rng.normal(visible + 1.0 - scatter**2 / 2, scatter, (10, 4)), np.zeros(10), ALPHA
            )
            > 0.0
            for _ in range(30)
        ]
        assert np.mean(found) > 0.9
        assert visible < 3.0


def test_collapsed_particles_see_nothing():
    rng = np.random.default_rng(4)
    assert visible_shortfall(rng.normal(-60.0, 8.0, (10, 4)), np.zeros(10), ALPHA) > 30.0
