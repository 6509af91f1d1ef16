"""The plan of Chib and Jeliazkov's estimator: its centre, its width and what it promises."""

import numpy as np
import pytest

from pymc_statespace_filters.evidence.estimators import random_walk_proposal as _proposal
from pymc_statespace_filters.evidence.estimators.random_walk_proposal import Proposal, plan_proposal
from pymc_statespace_filters.evidence.posterior import Posterior
from tests.evidence.analytic import gaussian, pilot

LOG_EVIDENCE = -3.7  # of `gaussian`


def standard_normal(shape, k, rng):
    def log_density(x):
        return -0.5 * (x**2).sum(axis=-1)

    draws = rng.standard_normal((*shape, k))
    return Posterior(draws, log_density(draws), lambda x, rng: log_density(x))


@pytest.mark.parametrize("scale", [0.7, 1.0, 1.4])
@pytest.mark.parametrize("k", [1, 3])
def test_predicted_variances_are_those_of_a_gaussian_posterior(k, scale):
    posterior = standard_normal((4, 25_000), k, np.random.default_rng([70, k]))
    proposal = Proposal(np.zeros(k), 0.0, np.eye(k), scale)
    numerator, denominator = _proposal._predicted_variances(
        proposal, posterior, 0.5 * k * np.log(2 * np.pi)
    )
    square = scale**2
    exact = (1 + 1 / (square * (square + 2))) ** (k / 2) - 1
    assert numerator * posterior.log_density.size == pytest.approx(exact, rel=0.1)
    exact = (1 + square**2 / (1 + 2 * square)) ** (k / 2) - 1
    assert denominator == pytest.approx(exact, rel=0.1)


@pytest.mark.parametrize("noise_sd", [0.0, 1.0])
def test_the_pilot_meets_the_evidence_roughly(noise_sd):
    rng = np.random.default_rng(71)
    posterior = gaussian(3, (4, 1000), rng, noise_sd=noise_sd)
    # Of 500 proposals, whose weights have a standard deviation of 1.3 with noise: an error of 0.06.
    assert (
        abs(_proposal._pilot(posterior, pilot(posterior)) - LOG_EVIDENCE) < 0.01 + 0.25 * noise_sd
    )


def test_no_centre_lies_in_the_hole_of_a_ring():
    """Mean, median and the centres of two halves are all inside it."""
    rng = np.random.default_rng(72)

    def log_density(x):
        return -50 * (np.linalg.norm(x, axis=-1) - 5) ** 2

    angle = rng.uniform(0, 2 * np.pi, (4, 500))
    radius = rng.normal(5, 0.1, (4, 500))
    draws = radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    posterior = Posterior(draws, log_density(draws), lambda x, rng: log_density(x))
    candidates = _proposal._candidates(posterior, rng)
    assert candidates
    assert all(4.5 < np.linalg.norm(candidate.point) < 5.5 for candidate in candidates)


def test_the_constant_of_a_noisy_likelihood_is_an_average():
    rng = np.random.default_rng(73)
    misses = []
    for _ in range(20):
        posterior = gaussian(2, (4, 100), rng, noise_sd=1.2)
        exact = gaussian(2, (4, 100), rng).evaluate
        for candidate in _proposal._candidates(posterior, rng):
            misses.append(candidate.log_density - exact(candidate.point[None], rng)[0])
    # One estimate misses by 1.4, the mean of 20 by 0.4.
    assert np.mean(np.square(misses)) ** 0.5 < 0.7


def test_the_error_is_the_promised_one():
    rng = np.random.default_rng(74)
    posterior = gaussian(4, (4, 5000), rng)
    plan = plan_proposal(posterior, pilot(posterior), n_proposals=2000, most=2000, rng=rng)
    assert plan.n_proposals == 2000
    numerator, denominator = _proposal._predicted_variances(plan.proposal, posterior, LOG_EVIDENCE)
    assert plan.se == pytest.approx((numerator + denominator / 2000) ** 0.5, rel=0.05)
