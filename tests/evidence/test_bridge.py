"""Bridge sampling on posteriors of known evidence, and the ways of being subtly wrong."""

from dataclasses import replace

import numpy as np
import pytest

from pymc_statespace_filters.evidence.estimators import bridge as module
from pymc_statespace_filters.evidence.estimators.bridge import Bridge
from tests.evidence.analytic import gaussian, half_normal
from tests.evidence.estimator_contract import EstimatorContract
from tests.evidence.targets import Banana, TwoModes, half_normally_distributed


class TestBridge(EstimatorContract):
    estimator = Bridge()


@pytest.mark.parametrize(
    "make", [lambda: Banana(12), lambda: TwoModes(2), half_normally_distributed]
)
def test_posteriors_unlike_a_normal_law(make):
    target, rng = make(), np.random.default_rng(21)
    found = Bridge().estimate(target.posterior((4, 2500), rng, correlation=0.8), rng=rng)
    assert abs(found.log_evidence - target.log_evidence) < 4 * found.se < 0.4


def test_autocorrelation_enlarges_the_error():
    rng = np.random.default_rng(36)
    posterior = TwoModes(2).posterior((4, 2500), rng, correlation=0.95)
    shuffled = rng.permutation(4 * 2500)
    independent = replace(
        posterior,
        draws=posterior.draws.reshape(-1, 2)[shuffled].reshape(4, 2500, 2),
        log_density=posterior.log_density.ravel()[shuffled].reshape(4, 2500),
    )
    sticky, loose = (Bridge().estimate(draws, rng=rng) for draws in (posterior, independent))
    assert sticky.se > 1.2 * loose.se
    assert sticky.settings["n_effective_draws"] < 0.3 * loose.settings["n_effective_draws"]


class TestNoisyLikelihood:
    def test_draws_are_never_evaluated_again(self):
        rng = np.random.default_rng(25)
        posterior = gaussian(2, (4, 500), rng, noise_sd=1.0)
        seen = []

        def evaluate(x, rng):
            seen.append(x)
            return posterior.evaluate(x, rng)

        Bridge().estimate(replace(posterior, evaluate=evaluate), rng=rng)
        points = {tuple(x) for x in np.concatenate(seen)}
        assert len(points) == sum(map(len, seen)) == Bridge().n_evaluations(posterior)
        assert points.isdisjoint(map(tuple, posterior.draws.reshape(-1, 2)))


class TestDoubts:
    def test_few_effective_draws(self):
        rng = np.random.default_rng(29)
        found = Bridge().estimate(gaussian(2, (4, 100), rng, correlation=0.95), rng=rng)
        assert "effective number of" in found.doubts[0]

    def test_a_posterior_that_the_normal_law_hardly_meets(self):
        """A funnel: the width of 19 parameters is the exponential of another."""
        rng = np.random.default_rng(30)

        def log_density(x):
            return -(x[..., 0] ** 2) / 18 - (
                0.5 * x[..., 1:] ** 2 * np.exp(-x[..., :1]) + x[..., :1] / 2
            ).sum(axis=-1)

        first = 3 * rng.standard_normal((4, 400, 1))
        rest = np.exp(first / 2) * rng.standard_normal((4, 400, 19))
        draws = np.concatenate([first, rest], axis=-1)
        posterior = replace(
            gaussian(20, (4, 400), rng),
            draws=draws,
            log_density=log_density(draws),
            evaluate=lambda x, rng: log_density(x),
        )
        found = Bridge().estimate(posterior, rng=rng)
        assert any("towards a Gaussian" in doubt for doubt in found.doubts)

    def test_the_gap_between_halves_is_in_units_of_its_error(self, monkeypatch):
        monkeypatch.setattr(module, "MAX_GAP", -1.0)
        gaps = []
        for run in range(30):
            rng = np.random.default_rng([34, run])
            found = Bridge().estimate(half_normal((4, 250), rng), rng=rng)
            gaps.append(float(found.doubts[-1].split("differ by ")[1].split(" standard")[0]))
        assert 0.4 < np.mean(np.square(gaps)) < 2.0  # 1 within 0.26

    def test_halves_that_disagree(self):
        rng = np.random.default_rng(31)
        posterior = gaussian(1, (4, 1000), rng)
        posterior.log_density[:, :500] += 1.0
        found = Bridge().estimate(posterior, rng=rng)
        assert any("the halves of the draws differ" in doubt for doubt in found.doubts)
