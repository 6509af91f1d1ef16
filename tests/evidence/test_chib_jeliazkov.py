"""The estimator on posteriors known in closed form, and the ways of being subtly wrong."""

from dataclasses import replace

import numpy as np
import pytest

from pymc_statespace_filters.evidence.estimators import chib_jeliazkov as module
from pymc_statespace_filters.evidence.estimators.chib_jeliazkov import (
    ChibJeliazkov,
    estimate_in_one_block,
)
from pymc_statespace_filters.evidence.estimators.random_walk_proposal import plan_proposal
from tests.evidence.analytic import gaussian, half_normal, pilot
from tests.evidence.estimator_contract import EstimatorContract

LOG_EVIDENCE = -3.7  # of `gaussian`


class TestChibJeliazkov(EstimatorContract):
    estimator, of_few = ChibJeliazkov(5000, 1), ChibJeliazkov(600, 1)
    most = 0.2


def test_autocorrelation_enlarges_the_error():
    rng = np.random.default_rng(12)
    posterior = gaussian(2, (4, 4000), rng, correlation=0.95)
    shuffled = rng.permutation(4 * 4000)
    independent = replace(
        posterior,
        draws=posterior.draws.reshape(-1, 2)[shuffled].reshape(4, 4000, 2),
        log_density=posterior.log_density.ravel()[shuffled].reshape(4, 4000),
    )
    sticky = ChibJeliazkov(20_000).estimate(posterior, rng=rng)
    assert sticky.se > 1.5 * ChibJeliazkov(20_000).estimate(independent, rng=rng).se


def test_effective_numbers_and_the_error_say_the_same():
    rng = np.random.default_rng(20)
    found = ChibJeliazkov(1000).estimate(gaussian(2, (4, 500), rng, correlation=0.8), rng=rng)
    worth = [found.settings[f"n_effective_{mean}"] for mean in ("numerator", "denominator")]
    assert sum(1 / number for number in worth) == pytest.approx(found.se**2, rel=1e-12)


def test_the_share_of_impossible_proposals_is_that_of_both_halves():
    rng, calls = np.random.default_rng(22), []
    posterior = half_normal((4, 500), rng)

    def recorded(x, rng):
        calls.append(posterior.evaluate(x, rng))
        return calls[-1]

    found = ChibJeliazkov(1000).estimate(replace(posterior, evaluate=recorded), rng=rng)
    proposals = [values for values in calls[-2:] if len(values) == 500]
    assert found.settings["zero_density"] == np.isneginf(proposals).mean() > 0


def test_the_gap_between_halves_is_in_units_of_its_error(monkeypatch):
    monkeypatch.setattr(module, "MAX_GAP", -1.0)
    gaps = []
    for run in range(30):
        rng = np.random.default_rng([21, run])
        found = ChibJeliazkov(500).estimate(gaussian(2, (4, 250), rng), rng=rng)
        gaps.append(float(found.doubts[-1].split("differ by ")[1].split(" standard")[0]))
    assert 0.4 < np.mean(np.square(gaps)) < 2.0  # 1 within 0.26


class TestNoisyLikelihood:
    """Log-noise of standard deviation 1.2, as in a particle filter tuned as it should be."""

    def posterior(self, rng):
        return gaussian(2, (4, 5000), rng, noise_sd=1.2)

    @pytest.mark.parametrize("shift", [-1.0, 1.0])
    def test_the_constant_at_the_centre_does_not_matter(self, shift):
        rng = np.random.default_rng(15)
        posterior = self.posterior(rng)
        proposal = plan_proposal(
            posterior, pilot(posterior), n_proposals=10_000, most=10_000, rng=rng
        ).proposal
        shifted = replace(proposal, log_density=proposal.log_density + shift)
        found = estimate_in_one_block(shifted, posterior, 10_000, rng=rng)
        assert abs(found.log_evidence - LOG_EVIDENCE) < 4 * found.se


def test_two_separate_modes_are_centred_in_one_of_them():
    rng = np.random.default_rng(16)
    sign = rng.choice([-1.0, 1.0], size=(4, 5000, 1))
    draws = 5 * sign + rng.standard_normal((4, 5000, 2))
    posterior = gaussian(2, (4, 5000), rng)

    def log_density(x):
        centred = [-0.5 * ((x - c) ** 2).sum(axis=-1) for c in (-5.0, 5.0)]
        return np.logaddexp(*centred) - np.log(4 * np.pi) + LOG_EVIDENCE

    posterior = replace(
        posterior,
        draws=draws,
        log_density=log_density(draws),
        evaluate=lambda x, rng: log_density(x),
    )
    found = ChibJeliazkov(5000).estimate(posterior, rng=rng)
    point = plan_proposal(
        posterior, pilot(posterior), n_proposals=5000, most=10_000, rng=rng
    ).proposal.point
    assert abs(point[0]) > 3
    assert abs(found.log_evidence - LOG_EVIDENCE) < 4 * found.se < 0.4
