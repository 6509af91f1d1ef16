"""Moves screened by another density leave the target as it is."""

import numpy as np
import pytest
from scipy.stats import norm

from pymc_statespace_filters.smc.kernel import fitted_kernel, metropolis
from pymc_statespace_filters.smc.particles import Particles, Populations

N = 40_000
TARGET, SCREEN = norm(0.0, 1.0), norm(0.7, 1.6)


def evaluating(law, seen=None):
    """Points as particles of a law; the screen is zero below -2.5."""

    def evaluate(x, rng):
        n = len(x)
        if seen is not None:
            seen.append(n)
        log_density = law.logpdf(x[:, 0])
        if law is SCREEN:
            log_density = np.where(x[:, 0] < -2.5, -np.inf, log_density)
        none = np.empty((n, 0))
        return Particles(x, np.zeros(n), np.zeros(n), log_density, none.astype(np.int64), none)

    return evaluate


@pytest.mark.parametrize("temperature", [1.0, 0.25])
def test_the_target_is_invariant(temperature):
    """Particles of the target, as far as the screen is positive, stay so: 4 errors of 4 moments."""
    rng, seen = np.random.default_rng(1), []
    evaluate = evaluating(TARGET, seen)
    law = norm(0.0, 1.0 / np.sqrt(temperature))
    start = law.rvs(3 * N, random_state=rng)
    x = start[start > -2.5][:N, np.newaxis]
    particles = evaluate(x, rng)
    population = Populations.of_equal_weights(particles.at(np.arange(500)), 1)
    kernel = fitted_kernel(population, 1.0, rng, evaluating(SCREEN))
    truth = [np.mean(x**k) for k in range(1, 5)]
    seen.clear()
    for _ in range(10):
        particles, rates = metropolis(particles, kernel, temperature, evaluate, rng)
        assert rates.n_evaluated == seen[-1] < 0.8 * N
    assert not np.isclose(particles.x, x).mean() > 0.2  # nearly all have moved
    for k, expected in enumerate(truth, start=1):
        powers = particles.x**k
        error = np.sqrt(2.0) * powers.std() / np.sqrt(N)
        assert abs(powers.mean() - expected) < 4 * error
    np.testing.assert_array_equal(particles.increment, TARGET.logpdf(particles.x[:, 0]))


def test_no_proposal_may_pass():
    rng = np.random.default_rng(1)
    evaluate = evaluating(TARGET)
    particles = evaluate(rng.normal(size=(50, 1)), rng)

    def impossible(x, rng):
        found = evaluate(x, rng)
        return found._replace(log_prior=np.full(len(x), -np.inf))

    kernel = fitted_kernel(Populations.of_equal_weights(particles, 1), 1.0, rng, impossible)
    moved, rates = metropolis(particles, kernel, 1.0, evaluate, rng)
    assert moved is particles
    assert rates.n_evaluated == rates.all == 0
