"""Populations are weighted by their evidences, and errors follow from their spread."""

import numpy as np
import pytest

from pymc_statespace_filters.smc.merging import (
    mean_and_error,
    merged_index,
    merged_log_evidence,
    merged_scores,
)
from pymc_statespace_filters.smc.particles import Particles, Populations

RNG = np.random.default_rng(5)


def populations(log_weights):
    n = np.size(log_weights)
    none = np.zeros((n, 0))
    zeros = np.zeros(n)
    particles = Particles(np.arange(n)[:, None] * 1.0, zeros, zeros, zeros, none, none)
    return Populations(particles, log_weights)


def test_a_population_counts_by_its_evidence():
    both = populations(np.log([[0.25, 0.75], [0.5, 0.5]]))
    log_evidences = np.log([1.0, 3.0]) - 500
    index = merged_index(both, log_evidences, 16_000, RNG)
    shares = np.bincount(index) / index.size
    np.testing.assert_allclose(shares, [1 / 16, 3 / 16, 3 / 8, 3 / 8], atol=1e-3)
    mean, _ = mean_and_error(both.particles.x[:, 0], both, log_evidences)
    assert mean == pytest.approx(0.75 * 2.5 + 0.25 * 0.75)
    assert merged_log_evidence(log_evidences)[0] == pytest.approx(np.log(2) - 500)


def test_intervals_from_few_populations_hold():
    """95 % intervals of log-evidences and means, of 5 populations, in 2000 replications.

    The counts are binomial; 4 standard deviations are exceeded by chance once in 16 000 tests.
    """
    n, r = 2000, 5
    noise = 0.05 * RNG.standard_normal((n, r))
    evidence_holds, mean_holds = 0, 0
    for own in noise:
        value, error = merged_log_evidence(np.log1p(own) - 3.0)
        evidence_holds += abs(value + 3.0) < 1.96 * error
        both = populations(np.zeros((r, 1)))
        mean, error = mean_and_error(RNG.standard_normal(r), both, np.zeros(r))
        mean_holds += abs(mean) < 1.96 * error
    for holds in (evidence_holds, mean_holds):
        assert abs(holds - 0.95 * n) < 4 * (n * 0.95 * 0.05) ** 0.5 + 0.005 * n


def test_errors_common_to_all_rows_cancel_in_scores():
    path = np.cumsum(RNG.standard_normal(6))
    common = 0.1 * RNG.standard_normal((8, 1))
    scores, deviations = merged_scores(path + common)
    np.testing.assert_allclose(scores[1:], np.diff(path), atol=1e-12)
    np.testing.assert_allclose(deviations[:, 1:], 0.0, atol=1e-12)
    error = np.linalg.norm(deviations[:, 0])
    assert error == pytest.approx(merged_log_evidence(path[0] + common[:, 0])[1])


def test_a_population_without_likelihood_has_no_evidence_and_keeps_its_particles():
    both = populations(np.log([[0.5, 0.5], [0.5, 0.5]]))
    increment = np.array([0.0, -np.inf, -np.inf, -np.inf])
    particles = both.particles._replace(increment=increment)
    raised, log_mean = both._replace(particles=particles).raised(0.5)
    np.testing.assert_array_equal(log_mean, [np.log(0.5), -np.inf])
    np.testing.assert_allclose(np.exp(raised.log_weights), [[1, 0], [0.5, 0.5]])
