"""What holds for every estimator of the evidence, on posteriors known in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from pymc_statespace_filters.errors import DataMismatchError
from tests.evidence.analytic import gaussian, half_normal
from tests.evidence.calibration import check_scores
from tests.evidence.targets import Regression

LOG_EVIDENCE = -3.7  # of `gaussian`


class EstimatorContract:
    """Inherit and give ``estimator``."""

    most = 0.06  # four standard errors are less; what is forgotten or counted twice is more
    of_few = None  # the same with few proposals, for the test that has many runs
    reads_estimates = True  # those of the likelihood that are stored beside the draws

    def check(self, posterior, truth, rng):
        """Within four standard errors, which fails once in 16 000; seeds are fixed."""
        found = self.estimator.estimate(posterior, rng=rng)
        assert abs(found.log_evidence - truth) < 4 * found.se < self.most
        return found

    @pytest.mark.parametrize("k", [2, 5])
    def test_evidence_of_a_conjugate_regression(self, k):
        rng = np.random.default_rng([20, k])
        regression = Regression(k, 2 * k + 10, rng)
        posterior = regression.posterior((4, 2500), rng, correlation=0.5)
        assert not self.check(posterior, regression.log_evidence, rng).doubts

    def test_proposals_without_density_count_as_zeros(self):
        """A tenth of them and more, of two half-normals: without these the error is above 0.1."""
        rng = np.random.default_rng(23)
        one, other = (half_normal((4, 2500), rng) for _ in range(2))
        draws = np.concatenate([one.draws, other.draws], axis=-1)

        def evaluate(x, rng):
            return np.where((x > 0).all(axis=1), -0.5 * (x**2).sum(axis=1), -np.inf)

        log_density = one.log_density + other.log_density
        posterior = replace(one, draws=draws, log_density=log_density, evaluate=evaluate)
        self.check(posterior, np.log(np.pi / 2), rng)

    def test_a_noisy_likelihood_gives_the_evidence_of_its_expectation(self):
        """From the estimates that the chain accepted; recomputed ones would not give it."""
        rng = np.random.default_rng(25)
        posterior = gaussian(2, (4, 5000), rng, noise_sd=1.0)
        self.check(posterior, LOG_EVIDENCE, rng)
        if self.reads_estimates:
            fresh = posterior.evaluate(posterior.draws.reshape(-1, 2), rng).reshape(4, 5000)
            wrong = self.estimator.estimate(replace(posterior, log_density=fresh), rng=rng)
            assert abs(wrong.log_evidence - LOG_EVIDENCE) > 8 * wrong.se

    def test_errors_are_those_that_are_made(self):
        """Of 50 scores; `test_calibration` has more of them, and more posteriors."""
        scores = []
        for run in range(50):
            rng = np.random.default_rng([35, run])
            posterior = gaussian(2, (4, 250), rng, correlation=0.8, noise_sd=1.0)
            found = (self.of_few or self.estimator).estimate(posterior, rng=rng)
            scores.append((found.log_evidence - LOG_EVIDENCE) / found.se)
        check_scores(scores)

    def test_units_do_not_matter(self):
        """Same seed, same number: the Jacobian of other units is taken back."""
        found = []
        for units in (np.ones(2), np.array([1e-8, 1e8])):
            rng = np.random.default_rng(27)
            unscaled = gaussian(2, (4, 1000), rng)
            posterior = replace(
                unscaled,
                draws=unscaled.draws * units,
                evaluate=lambda x, rng, p=unscaled, u=units: p.evaluate(x / u, rng),
            )
            found.append(self.estimator.estimate(posterior, rng=rng).log_evidence)
        assert found[1] == pytest.approx(found[0], abs=1e-6)

    def test_no_density_where_the_draws_are(self):
        rng = np.random.default_rng(33)
        posterior = gaussian(2, (2, 500), rng)
        nowhere = replace(posterior, evaluate=lambda x, rng: np.full(len(x), -np.inf))
        with pytest.raises(DataMismatchError, match="another model"):
            self.estimator.estimate(nowhere, rng=rng)
