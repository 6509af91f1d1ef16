"""Importance sampling on posteriors of known evidence, and the ways of being subtly wrong."""

from dataclasses import replace

import numpy as np
import pytest

from pymc_statespace_filters.evidence.estimators.importance import Importance
from pymc_statespace_filters.statistics.importance import pareto_k
from tests.evidence.analytic import gaussian
from tests.evidence.estimator_contract import EstimatorContract
from tests.evidence.hard_targets import Funnel
from tests.evidence.targets import Banana, Regression, TwoModes, bounded, half_normally_distributed

LOG_EVIDENCE = -3.7  # of `gaussian`


class TestImportance(EstimatorContract):
    estimator = Importance()
    reads_estimates = False


@pytest.mark.parametrize(
    "make", [lambda: Banana(12), lambda: TwoModes(3), half_normally_distributed, bounded]
)
def test_posteriors_unlike_a_normal_law(make):
    target, rng = make(), np.random.default_rng(52)
    found = Importance().estimate(target.posterior((4, 2500), rng, correlation=0.8), rng=rng)
    assert abs(found.log_evidence - target.log_evidence) < 4 * found.se < 0.06
    assert not found.doubts


def test_draws_are_never_evaluated_again():
    """Fresh points alone, each evaluated once."""
    rng = np.random.default_rng(55)
    posterior = gaussian(2, (4, 500), rng, noise_sd=1.0)
    seen = []

    def evaluate(x, rng):
        seen.append(x)
        return posterior.evaluate(x, rng)

    importance = Importance()
    importance.estimate(replace(posterior, evaluate=evaluate), rng=rng)
    points = {tuple(x) for x in np.concatenate(seen)}
    assert len(points) == sum(map(len, seen)) == importance.n_evaluations(posterior)
    assert points.isdisjoint(map(tuple, posterior.draws.reshape(-1, 2)))


@pytest.mark.parametrize("wrong", [-2.0, 2.0])
def test_draws_only_say_where_to_look(wrong):
    """Draws that are too narrow or too wide cost precision, not truth."""
    rng = np.random.default_rng(56)
    posterior = gaussian(2, (4, 2500), rng)
    mean = posterior.draws.mean(axis=(0, 1))
    draws = mean + (posterior.draws - mean) * 2 ** (wrong / 4)
    log_density = posterior.evaluate(draws.reshape(-1, 2), rng).reshape(4, 2500)
    posterior = replace(posterior, draws=draws, log_density=log_density)
    found = Importance().estimate(posterior, rng=rng)
    assert abs(found.log_evidence - LOG_EVIDENCE) < 4 * found.se < 0.05


def test_tail_of_the_weights():
    """Weights u^-k have the tail k, zeros among them or not; 4 of its errors at most."""
    u = np.random.default_rng(57).uniform(size=20_000)
    for k in (0.3, 0.9):
        assert pareto_k(-k * np.log(u)) == pytest.approx(k, abs=0.25)
        assert pareto_k(np.where(u > 0.9, -np.inf, -k * np.log(u))) == pytest.approx(k, abs=0.25)


def test_weights_of_heavy_tail_are_doubted():
    """Log-noise of standard deviation 3: a few estimates of 1000 outweigh all others."""
    rng = np.random.default_rng(58)
    found = Importance().estimate(gaussian(2, (4, 250), rng, noise_sd=3.0), rng=rng)
    assert found.settings["pareto_k"] > 0.7
    few, tail = found.doubts
    assert "effective number of" in few
    assert "heavy tail (Pareto k" in tail


def test_what_no_proposal_has_sampled_is_a_part_of_the_error():
    """The neck of a funnel: no weight shows that it is missing, but the draws lie there."""
    target, rng = Funnel(8), np.random.default_rng(57)
    found = Importance().estimate(target.posterior((4, 2500), rng), rng=rng)
    unsampled = found.settings["unsampled"]
    assert found.se > unsampled > 0.02
    assert any("has not been sampled" in doubt for doubt in found.doubts)
    assert abs(found.log_evidence - target.log_evidence) < 4 * found.se


def test_no_more_is_evaluated_where_few_terms_stay_few():
    """Noise of variance 30: of any number of estimates a few decide."""
    rng, seen = np.random.default_rng(58), []
    posterior = Regression(2, 20, rng).posterior((4, 500), rng, noise_sd=30**0.5)

    def evaluate(x, rng):
        seen.append(len(x))
        return posterior.evaluate(x, rng)

    found = Importance(target_se=0.01).estimate(replace(posterior, evaluate=evaluate), rng=rng)
    assert found.settings["n_effective_proposals"] < 10
    assert sum(seen) < 8000
    assert found.doubts
    assert found.shortfall
