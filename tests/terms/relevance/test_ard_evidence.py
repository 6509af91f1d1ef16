"""The closed form of the evidence, its derivatives and its maximum."""

import itertools

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import multivariate_normal, norm

from pymc_statespace_filters.terms.relevance.ard_evidence import ABSENT, ArdEvidence
from pymc_statespace_filters.terms.relevance.optimum import largest_evidence, largest_without


def some_evidence(n_components=3, p=4, seed=1):
    """A likelihood of which one component says nothing."""
    rng = np.random.default_rng(seed)
    factors = rng.standard_normal((n_components, p, p))
    factors[0] = 0.0
    precisions = factors @ np.swapaxes(factors, 1, 2)
    shifts = (factors @ rng.standard_normal((n_components, p, 1)))[..., 0]
    return ArdEvidence(rng.standard_normal(n_components), precisions, 2 * shifts)


def test_the_evidence_of_one_term_is_its_integral():
    evidence = ArdEvidence(
        np.log([0.4, 0.2]), np.array([[[3.0]], [[0.5]]]), np.array([[2.0], [-1.0]])
    )

    def likelihood(phi):
        return 0.4 * np.exp(-1.5 * phi**2 + 2 * phi) + 0.2 * np.exp(-0.25 * phi**2 - phi)

    for log_alpha in (-3.0, 0.0, 2.0):
        prior = norm(scale=np.exp(-0.5 * log_alpha))
        integral = quad(lambda phi, prior=prior: likelihood(phi) * prior.pdf(phi), -40, 40)
        found = evidence.log_evidence(np.array([log_alpha]))
        assert found == pytest.approx(np.log(integral[0]), abs=1e-8)
    absent = evidence.log_evidence(np.array([ABSENT]))
    assert absent == pytest.approx(np.log(0.6), abs=1e-10)


def test_derivatives_are_those_of_differences():
    evidence, at, step = some_evidence(), np.array([0.3, -1.0, 2.0, 0.1]), 1e-5
    found = evidence.derivatives(at)
    assert found.value == evidence.log_evidence(at)
    moves = step * np.eye(4)
    gradient = (evidence.log_evidence(at + moves) - evidence.log_evidence(at - moves)) / (2 * step)
    np.testing.assert_allclose(found.gradient, gradient, atol=1e-8)
    for move, row in zip(moves, found.hessian, strict=True):
        ends = [evidence.derivatives(at + sign * move).gradient for sign in (1, -1)]
        np.testing.assert_allclose(row, (ends[0] - ends[1]) / (2 * step), atol=1e-8)


def test_the_posterior_of_a_regression_is_exact():
    rng = np.random.default_rng(2)
    design, y = rng.standard_normal((12, 3)), rng.standard_normal(12)
    evidence = ArdEvidence(np.zeros(1), (design.T @ design)[None], (design.T @ y)[None])
    log_alpha = np.array([0.5, -0.7, 1.1])
    marginal = np.eye(12) + design @ np.diag(np.exp(-log_alpha)) @ design.T
    with_terms = multivariate_normal(cov=marginal).logpdf(y)
    without = multivariate_normal(cov=np.eye(12)).logpdf(y)
    assert evidence.log_evidence(log_alpha) == pytest.approx(with_terms - without, abs=1e-10)
    found = evidence.posterior(log_alpha)
    across = np.diag(np.exp(-log_alpha)) @ design.T @ np.linalg.inv(marginal)
    np.testing.assert_allclose(found.means[0], across @ y, rtol=1e-10)
    cov = np.diag(np.exp(-log_alpha)) - across @ design @ np.diag(np.exp(-log_alpha))
    np.testing.assert_allclose(found.covs[0], cov, rtol=1e-9, atol=1e-12)


def test_orthogonal_terms_have_the_optimum_of_a_formula():
    """With t standard errors it is the precision 1 / (sd^2 (t^2 - 1)), and infinite below one."""
    t, precision = np.array([5.0, -3.0, 0.5, 1.2, 0.1]), np.array([4.0, 9.0, 1.0, 25.0, 3.0])
    shifts = np.sqrt(precision) * t
    evidence = ArdEvidence(np.zeros(1), np.diag(precision)[None], shifts[None])
    found = largest_evidence(evidence, np.random.default_rng(1))
    expected = np.log(precision / np.maximum(t**2 - 1, 1e-300))
    np.testing.assert_allclose(found, np.where(np.abs(t) > 1, expected, ABSENT), atol=1e-6)
    relevance = evidence.relevance(found)
    np.testing.assert_allclose(relevance, np.maximum(1 - t**-2.0, 0), atol=1e-8)
    gain = evidence.log_evidence(found) - evidence.log_evidence(largest_without(evidence, found, 1))
    assert gain == pytest.approx(4.0 - np.log(3.0), abs=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_the_largest_of_several_maxima_is_found(seed):
    """Two terms that stand for each other: against a fine grid, with absent terms on it."""
    rng = np.random.default_rng(seed)
    factor = np.array([1.0, 0.97])
    precisions = np.stack([20 * np.outer(factor, factor), np.diag([3.0, 0.1])]) + 0.1 * np.eye(2)
    shifts = np.stack([20 * factor, [4.0, 0.2]]) * (1 + 0.3 * rng.standard_normal((2, 2)))
    evidence = ArdEvidence(rng.standard_normal(2), precisions, shifts)
    grid = np.append(np.linspace(-8, 12, 201), ABSENT)
    every = evidence.log_evidence(np.array([*itertools.product(grid, grid)]))
    found = largest_evidence(evidence, rng)
    assert evidence.log_evidence(found) >= every.max() - 1e-9


def test_where_no_term_is_needed_all_are_absent():
    evidence = ArdEvidence(np.zeros(1), np.eye(3)[None], 0.5 * np.ones((1, 3)))
    found = largest_evidence(evidence, np.random.default_rng(1))
    np.testing.assert_array_equal(found, [ABSENT] * 3)
