"""The largest likelihood: found where it is, and never the luckiest of noisy values."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.estimators.largest_likelihood import (
    N_EVALUATIONS,
    N_VALUING,
    max_log_likelihood,
)
from pymc_statespace_filters.evidence.estimators.newton import (
    EdgeError,
    best_of_chains,
    derivatives,
    newton_maximize,
)
from pymc_statespace_filters.evidence.estimators.whitening import moments, moments_within_chains
from pymc_statespace_filters.evidence.posterior import Posterior
from tests.evidence.targets import (
    Banana,
    Regression,
    TwoModes,
    bounded,
    half_normally_distributed,
)


def largest(posterior):
    return max_log_likelihood(posterior, np.random.default_rng(0))


def least_squares(regression):
    point = np.linalg.lstsq(regression.x, regression.y)[0]
    return point, float(regression.log_likelihood(point[np.newaxis])[0])


@pytest.mark.parametrize("k", [2, 6, 12])
def test_least_squares(k):
    rng = np.random.default_rng([50, k])
    regression = Regression(k, 40, rng)
    point, value = least_squares(regression)
    found = largest(regression.posterior((4, 250), rng))
    np.testing.assert_allclose(found.point, point, atol=1e-5)
    assert found.log_likelihood == pytest.approx(value, abs=1e-8)


def test_hundreds_of_parameters_need_no_hessian():
    """The differences for it would be some 40 000 points of 200 numbers, at every step."""
    regression = Regression(200, 400, np.random.default_rng(52))
    point, value = least_squares(regression)
    largest_call = 0

    def log_likelihood(x):
        nonlocal largest_call
        largest_call = max(largest_call, len(x))
        return regression.log_likelihood(x)

    found = newton_maximize(log_likelihood, np.zeros(200))
    assert largest_call == 400
    np.testing.assert_allclose(found.point, point, atol=1e-4)
    assert found.value == pytest.approx(value, abs=1e-6)


def test_the_prior_has_no_part_in_it():
    """A prior so narrow that the posterior is far from the maximum."""
    rng = np.random.default_rng(51)
    regression = Regression(3, 40, rng, scale=0.01)
    found = largest(regression.posterior((4, 250), rng))
    assert found.log_likelihood == pytest.approx(least_squares(regression)[1], abs=1e-7)


def test_a_transform_does_not_matter():
    """The maximum over s of N(0, s^2) is at the root mean square; a Jacobian would move it."""
    target = half_normally_distributed()
    found = largest(target.posterior((4, 250), np.random.default_rng(52)))
    best = np.sqrt((target.Y**2).mean())
    assert found.point[0] == pytest.approx(np.log(best), abs=1e-5)
    assert found.log_likelihood == pytest.approx(norm.logpdf(target.Y, scale=best).sum(), abs=1e-8)


def test_a_maximum_at_a_bound_is_infinitely_far():
    target = bounded()
    found = largest(target.posterior((4, 250), np.random.default_rng(53)))
    at_bound = norm.logpdf(target.Y, scale=0.9).sum()
    assert found.log_likelihood == pytest.approx(at_bound, abs=2e-4)
    assert found.log_likelihood <= at_bound


@pytest.mark.parametrize("k", [1, 3, 6])
def test_a_maximum_at_the_edge_of_a_box_without_a_transform(k):
    """Likelihood N(x; 2, 1) for each parameter, the first of them below 0.5."""
    rng = np.random.default_rng([54, k])

    class Box:
        def log_density(self, x):
            return np.where(x[:, 0] < 0.5, 0.0, -np.inf)

    def log_density(x, rng):
        return Box().log_density(x) - 0.5 * ((x - 2) ** 2).sum(axis=1)

    draws = 2 + rng.standard_normal((4, 1000, k))
    draws[..., 0] = 0.5 - rng.exponential(0.5, (4, 1000))
    stored = log_density(draws.reshape(-1, k), rng).reshape(4, 1000)
    found = largest(Posterior(draws, stored, log_density, prior=Box()))
    assert found.log_likelihood == pytest.approx(-0.5 * 1.5**2, abs=1e-3)


def test_of_two_modes_the_higher():
    target = TwoModes(2)
    found = largest(target.posterior((4, 250), np.random.default_rng(55)))
    np.testing.assert_allclose(found.point, target.CENTRES[1, :2], atol=1e-3)


def test_a_curved_ridge():
    target = Banana(6)
    found = largest(target.posterior((4, 250), np.random.default_rng(56)))
    assert found.log_likelihood == pytest.approx(5 * norm.logpdf(0, scale=0.4), abs=1e-6)


def test_few_evaluations():
    rng = np.random.default_rng(57)
    posterior = Regression(4, 40, rng).posterior((4, 250), rng)
    rows = []

    def counted(x, rng):
        rows.append(len(x))
        return posterior.evaluate(x, rng)

    largest(replace(posterior, evaluate=counted))
    assert sum(rows) < N_EVALUATIONS
    assert len(rows) < 30


def test_never_less_than_the_best_draw():
    """A likelihood that cannot be climbed: fresh evaluations fall short of the stored ones."""
    rng = np.random.default_rng(58)
    target = Regression(2, 30, rng)
    posterior = target.posterior((2, 100), rng)
    log_likelihood = posterior.log_density.ravel() - target.prior.log_density(
        posterior.draws.reshape(-1, 2)
    )
    found = largest(replace(posterior, evaluate=lambda x, rng: np.full(len(x), -np.inf)))
    assert found.log_likelihood == log_likelihood.max()
    best = posterior.draws.reshape(-1, 2)[log_likelihood.argmax()]
    np.testing.assert_allclose(found.point, best, rtol=1e-12)


class TestNoisyLikelihood:
    """Log-noise of standard deviation 1: the luckiest of 4000 estimates is three nats too high."""

    @pytest.mark.parametrize("target", [Regression(4, 40, np.random.default_rng(59)), Banana(3)])
    def test_near_the_maximum_and_not_above_it(self, target):
        values = []
        for seed in range(10):
            rng = np.random.default_rng([60, seed])
            found = max_log_likelihood(target.posterior((4, 1000), rng, noise_sd=1.0), rng)
            values.append(found.log_likelihood)
        exact = largest(target.posterior((4, 1000), np.random.default_rng(61))).log_likelihood
        # Each value has an error of sqrt(exp(1) - 1) / 10 = 0.13, their mean one of 0.04.
        assert -0.4 < np.mean(values) - exact < 0.15

    def test_few_evaluations(self):
        rng = np.random.default_rng(62)
        posterior = Banana(3).posterior((4, 1000), rng, noise_sd=1.0)
        rows = []

        def counted(x, rng):
            rows.append(len(x))
            return posterior.evaluate(x, rng)

        largest(replace(posterior, evaluate=counted))
        assert sum(rows) == N_EVALUATIONS < 400

    def test_the_winner_is_valued_by_estimates_that_did_not_choose_it(self):
        rng = np.random.default_rng(63)
        posterior = Banana(3).posterior((4, 250), rng, noise_sd=1.0)
        calls = []

        def recorded(x, rng):
            calls.append((x, posterior.evaluate(x, rng)))
            return calls[-1][1]

        found = max_log_likelihood(replace(posterior, evaluate=recorded), rng)
        x, values = calls[-1]
        likelihoods = np.exp(values - posterior.prior.log_density(x))
        assert len(x) == N_VALUING
        assert found.log_likelihood == pytest.approx(np.log(likelihoods.mean()), rel=1e-12)


# Newton's method on numbers: exact derivatives of a quadratic, and where there are none.


def test_coordinates_are_those_within_chains():
    rng = np.random.default_rng(43)
    within = rng.standard_normal((2, 100, 3))
    draws = within + np.array([-50.0, 50.0])[:, None, None]
    chol = moments_within_chains(draws).chol
    expected = np.mean([np.cov(chain, rowvar=False, ddof=0) for chain in within], axis=0)
    np.testing.assert_allclose(chol @ chol.T, expected, rtol=1e-12)


@pytest.mark.parametrize("coordinates", [moments, moments_within_chains])
def test_draws_that_do_not_vary_have_no_coordinates(coordinates):
    draws = np.random.default_rng(39).standard_normal((2, 500, 2))
    draws[..., 1] = 0.0
    with pytest.raises(ModelError, match="vary in every direction"):
        coordinates(draws)


def test_a_search_starts_in_the_best_chains():
    values = np.array([[0.0, 2.0, 1.0], [-9.0, -8.0, -7.0], [4.0, 3.0, 3.5]])
    assert best_of_chains(values, 2).tolist() == [6, 1]
    assert best_of_chains(values, 9).tolist() == [6, 1, 5]


@pytest.mark.parametrize(
    "climb", [lambda x: 0.01 * x[:, 0], lambda x: -np.exp(-x[:, 0])], ids=["grows", "levels off"]
)
def test_a_climb_without_end_ends(climb):
    found = newton_maximize(climb, np.zeros(1))
    assert found.value > climb(np.array([[3.0]]))[0]
    assert not found.at_edge


def test_derivatives_of_a_quadratic_are_exact():
    rng = np.random.default_rng(40)
    root, slope, point = rng.standard_normal((3, 3)), rng.standard_normal(3), np.ones(3)
    form = root @ root.T
    calls = []

    def quadratic(x):
        calls.append(len(x))
        return 0.5 * np.einsum("mi,ij,mj->m", x, form, x) + x @ slope

    gradient, hessian = derivatives(quadratic, point, 0.1)
    np.testing.assert_allclose(gradient, form @ point + slope, atol=1e-10)
    np.testing.assert_allclose(hessian, form, atol=1e-10)
    assert calls == [13]


def test_there_are_no_derivatives_at_an_edge():
    with pytest.raises(EdgeError):
        derivatives(lambda x: np.where(x[:, 0] < 0, -np.inf, x[:, 0]), np.array([0.05]), 0.1)
