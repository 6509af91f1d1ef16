"""Laplace's approximation: exact on Gaussians, and aware of what is none."""

import numpy as np
import pytest
from scipy.stats import t as student

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.estimators.laplace import Laplace
from pymc_statespace_filters.evidence.estimators.newton import EdgeError, derivatives
from pymc_statespace_filters.evidence.estimators.whitening import moments_within_chains
from pymc_statespace_filters.evidence.posterior import Posterior
from tests.evidence.analytic import Regression, gaussian, half_normal


def laplace(posterior):
    return Laplace().estimate(posterior, rng=np.random.default_rng(0))


@pytest.mark.parametrize("k", [2, 5, 12, 20])
def test_exact_on_a_conjugate_regression(k):
    rng = np.random.default_rng([30, k])
    regression = Regression(k, 40, rng)
    found = laplace(regression.posterior((4, 500), rng))
    assert found.log_evidence == pytest.approx(regression.log_evidence, abs=1e-6)
    assert np.isnan(found.se)
    assert not found.doubts


def test_exact_on_a_gaussian_of_parameters_with_scales_far_apart():
    rng = np.random.default_rng(31)
    scales = np.array([1e-6, 1.0, 1e5])

    def log_density(x):
        return -0.5 * ((x / scales - 2) ** 2).sum(axis=-1)

    draws = scales * (2 + rng.standard_normal((4, 500, 3)))
    found = laplace(Posterior(draws, log_density(draws), lambda x, rng: log_density(x)))
    truth = 1.5 * np.log(2 * np.pi) + np.log(scales).sum()
    assert found.log_evidence == pytest.approx(truth, abs=1e-6)


def test_a_bend_that_keeps_volumes_does_not_matter():
    rng = np.random.default_rng(32)

    def log_density(x):
        return -0.5 * (x[..., 0] ** 2 + (x[..., 1] - x[..., 0] ** 2) ** 2)

    draws = rng.standard_normal((4, 1000, 2))
    draws[..., 1] += draws[..., 0] ** 2
    found = laplace(Posterior(draws, log_density(draws), lambda x, rng: log_density(x)))
    assert found.log_evidence == pytest.approx(np.log(2 * np.pi), abs=1e-4)
    assert not found.doubts


def test_heavy_tails_are_a_doubt_of_the_right_size():
    rng = np.random.default_rng(33)
    draws = rng.standard_t(3, (4, 5000, 1))
    posterior = Posterior(
        draws, student.logpdf(draws[..., 0], 3), lambda x, rng: student.logpdf(x[:, 0], 3)
    )
    found = laplace(posterior)
    # The curvature of Student's density at zero is (n + 1) / n.
    truth = student.logpdf(0.0, 3) + 0.5 * np.log(2 * np.pi * 3 / 4)
    assert found.log_evidence == pytest.approx(truth, abs=1e-3)
    assert found.log_evidence < -0.2
    assert "nats below the mode on average where those of a Gaussian lie 0.50" in found.doubts[0]


def test_a_better_mode_of_another_chain_is_found():
    """Each chain sits in a mode; the higher of them counts (and R-hat, elsewhere, is a doubt)."""
    rng = np.random.default_rng(34)
    centres, heights = np.array([-20.0, 20.0]), np.array([0.0, 3.0])

    def log_density(x):
        return (heights - 0.5 * (x - centres) ** 2).max(axis=-1)

    draws = centres[:, None, None] + rng.standard_normal((2, 500, 1))
    found = laplace(Posterior(draws, log_density(draws), lambda x, rng: log_density(x)))
    assert found.log_evidence == pytest.approx(3 + 0.5 * np.log(2 * np.pi), abs=1e-6)


def test_a_rugged_log_density_is_a_doubt():
    rng = np.random.default_rng(35)
    posterior = gaussian(1, (2, 500), rng)

    def rugged(x, rng):
        return posterior.evaluate(x, rng) + 0.003 * np.sin(60 * x[:, 0])

    found = laplace(Posterior(posterior.draws, posterior.log_density, rugged))
    assert any("rugged" in doubt for doubt in found.doubts)


def test_a_noisy_likelihood_has_no_mode():
    posterior = gaussian(2, (2, 500), np.random.default_rng(36), noise_sd=0.1)
    with pytest.raises(ModelError, match=r"deterministic log-density.*use chib_jeliazkov"):
        laplace(posterior)


def test_a_mode_at_an_edge():
    with pytest.raises(ModelError, match="mode inside the support"):
        laplace(half_normal((2, 500), np.random.default_rng(37)))


@pytest.mark.parametrize(
    "slope", [lambda x: 0.01 * x, lambda x: -np.exp(-x)], ids=["grows", "levels off"]
)
def test_a_climb_without_end(slope):
    def log_density(x):
        return slope(x[..., 0])

    draws = np.random.default_rng(38).standard_normal((2, 500, 1))
    posterior = Posterior(draws, log_density(draws), lambda x, rng: log_density(x))
    with pytest.raises(ModelError, match="increases or levels off"):
        laplace(posterior)


def test_a_cusp_is_no_mode():
    """Of an asymmetric Laplace density: differences see a curvature there, and a slope."""

    def log_density(x):
        return np.where(x[..., 0] < 0, x[..., 0], -3 * x[..., 0])

    rng = np.random.default_rng(41)
    draws = rng.exponential(1 / 3, (2, 500, 1)) - rng.exponential(1, (2, 500, 1))
    posterior = Posterior(draws, log_density(draws), lambda x, rng: log_density(x))
    with pytest.raises(ModelError, match=r"curvature is \d.* and the largest gradient"):
        laplace(posterior)


def test_a_chain_far_from_its_top_is_climbed_too():
    """No draw of the second chain is among the best, and its mode is the higher one."""
    rng = np.random.default_rng(42)
    centres, heights = np.array([-20.0, 20.0]), np.array([0.0, 3.0])

    def log_density(x):
        return (heights - 0.5 * (x - centres) ** 2).max(axis=-1)

    draws = centres[:, None, None] + rng.standard_normal((2, 500, 1))
    draws[1] += 4 * np.sign(draws[1] - centres[1])
    found = laplace(Posterior(draws, log_density(draws), lambda x, rng: log_density(x)))
    assert found.log_evidence == pytest.approx(3 + 0.5 * np.log(2 * np.pi), abs=1e-6)


def test_coordinates_are_those_within_chains():
    rng = np.random.default_rng(43)
    within = rng.standard_normal((2, 100, 3))
    draws = within + np.array([-50.0, 50.0])[:, None, None]
    chol = moments_within_chains(draws).chol
    expected = np.mean([np.cov(chain, rowvar=False, ddof=0) for chain in within], axis=0)
    np.testing.assert_allclose(chol @ chol.T, expected, rtol=1e-12)


def test_draws_that_do_not_vary():
    posterior = gaussian(2, (2, 500), np.random.default_rng(39))
    posterior.draws[..., 1] = 0.0
    with pytest.raises(ModelError, match="vary in every direction"):
        laplace(posterior)


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
