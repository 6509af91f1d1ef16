"""Bridge sampling on posteriors of known evidence, and the ways of being subtly wrong."""

from dataclasses import replace

import numpy as np
import pytest

from pymc_statespace_filters.errors import DataMismatchError
from pymc_statespace_filters.evidence.estimators import bridge as module
from pymc_statespace_filters.evidence.estimators.bridge import Bridge
from tests.evidence.analytic import gaussian, half_normal
from tests.evidence.calibration import EACH_NUMBER_OF_RUNS, check_scores
from tests.evidence.targets import Banana, Regression, TwoModes, half_normally_distributed

LOG_EVIDENCE = -3.7  # of `gaussian`


# Errors of some 0.002: a forgotten determinant, ln 2 or number of terms would be hundreds of them.
@pytest.mark.parametrize("k", [2, 8, 20])
def test_evidence_of_a_conjugate_regression(k):
    rng = np.random.default_rng([20, k])
    regression = Regression(k, 2 * k + 10, rng)
    found = Bridge().estimate(regression.posterior((4, 2500), rng), rng=rng)
    assert abs(found.log_evidence - regression.log_evidence) < 4 * found.se < 0.02
    assert not found.doubts


@pytest.mark.parametrize(
    "make", [lambda: Banana(12), lambda: TwoModes(2), half_normally_distributed]
)
def test_posteriors_unlike_a_normal_law(make):
    target, rng = make(), np.random.default_rng(21)
    found = Bridge().estimate(target.posterior((4, 2500), rng, correlation=0.8), rng=rng)
    assert abs(found.log_evidence - target.log_evidence) < 4 * found.se < 0.4


def test_proposals_without_density_count_as_zeros():
    rng = np.random.default_rng(23)
    found = Bridge().estimate(half_normal((4, 2500), rng), rng=rng)
    assert abs(found.log_evidence - 0.5 * np.log(np.pi / 2)) < 4 * found.se < 0.03
    assert 0.05 < found.settings["zero_density"] < 0.2


@EACH_NUMBER_OF_RUNS
@pytest.mark.parametrize(
    ("k", "n_draws", "correlation", "noise_sd"),
    [
        (4, 100, 0.0, 0.0),  # most of the error is common to both halves
        (2, 250, 0.8, 1.0),
        pytest.param(2, 500, 0.9, 0.0, marks=pytest.mark.slow),
        pytest.param(12, 1000, 0.8, 0.0, marks=pytest.mark.slow),
    ],
)
def test_standard_errors_are_calibrated(k, n_draws, correlation, noise_sd, n_runs):
    scores = []
    for run in range(n_runs):
        rng = np.random.default_rng([35, run, k])
        posterior = gaussian(k, (4, n_draws), rng, correlation=correlation, noise_sd=noise_sd)
        found = Bridge().estimate(posterior, rng=rng)
        scores.append((found.log_evidence - LOG_EVIDENCE) / found.se)
    check_scores(scores)


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
    def test_stored_estimates_give_the_evidence_of_the_expected_likelihood(self):
        rng = np.random.default_rng(25)
        found = Bridge().estimate(gaussian(2, (4, 5000), rng, noise_sd=1.0), rng=rng)
        assert abs(found.log_evidence - LOG_EVIDENCE) < 4 * found.se < 0.05

    def test_recomputed_estimates_would_not(self):
        rng = np.random.default_rng(25)
        posterior = gaussian(2, (4, 5000), rng, noise_sd=1.0)
        fresh = posterior.evaluate(posterior.draws.reshape(-1, 2), rng).reshape(4, 5000)
        found = Bridge().estimate(replace(posterior, log_density=fresh), rng=rng)
        assert abs(found.log_evidence - LOG_EVIDENCE) > 15 * found.se

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


def test_scales_that_differ_by_many_orders():
    rng = np.random.default_rng(27)
    unscaled = gaussian(2, (4, 1000), rng)
    scale = np.array([1e-8, 1e8])
    posterior = replace(
        unscaled,
        draws=unscaled.draws * scale,
        evaluate=lambda x, rng: unscaled.evaluate(x / scale, rng),
    )
    found = Bridge().estimate(posterior, rng=rng)
    assert abs(found.log_evidence - LOG_EVIDENCE) < 4 * found.se < 0.05


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


def test_no_density_where_the_draws_are():
    rng = np.random.default_rng(33)
    posterior = replace(
        gaussian(2, (2, 500), rng), evaluate=lambda x, rng: np.full(len(x), -np.inf)
    )
    with pytest.raises(DataMismatchError, match="another model"):
        Bridge().estimate(posterior, rng=rng)
