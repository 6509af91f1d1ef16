"""The truths by which estimators of the evidence are judged are true."""

import numpy as np
import pytest
from scipy.stats import norm

import pymc_statespace_filters as psf
from tests.evidence import double_well
from tests.evidence.state_space import state_space
from tests.evidence.targets import (
    Banana,
    Regression,
    TwoModes,
    bounded,
    gamma_distributed,
    half_normally_distributed,
)

TARGETS = {
    "regression": (lambda: Regression(4, 30, np.random.default_rng(1)), 1e-9),
    "regression, 20": (lambda: Regression(20, 60, np.random.default_rng(1)), 1e-9),
    "banana": (lambda: Banana(12), 1e-5),
    "half-normal": (half_normally_distributed, 1e-4),
    "Gamma": (gamma_distributed, 1e-4),
    "bounded": (bounded, 1e-4),
    "state space": (state_space, 3e-4),
}


@pytest.mark.parametrize("name", TARGETS)
def test_evidence_map_and_density_agree_at_every_point(name):
    """Chib's identity, with the posterior's density from the map of the normals."""
    make, tolerance = TARGETS[name]
    target = make()
    rng, k = np.random.default_rng(5), target.n_normals
    z, h = 1.2 * rng.standard_normal((50, k)), 1e-4
    slopes = [
        (target.transport(z + h * e) - target.transport(z - h * e)) / (2 * h) for e in np.eye(k)
    ]
    log_posterior = norm.logpdf(z).sum(axis=-1) - np.linalg.slogdet(np.stack(slopes, axis=-1))[1]
    found = target.log_density(target.transport(z)) - log_posterior
    np.testing.assert_allclose(found, target.log_evidence, rtol=0, atol=tolerance)


def test_two_modes_by_quadrature():
    target = TwoModes(2)
    axis = np.linspace(-10.0, 10.0, 501)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    density = np.exp(target.log_density(grid)) * (axis[1] - axis[0]) ** 2
    assert np.log(density.sum()) == pytest.approx(target.log_evidence, abs=1e-9)

    # 200 000 independent draws: moments are off by four of their errors for one seed in thousands.
    draws = target.posterior((1, 200_000), np.random.default_rng(6)).draws[0]
    for moment in (lambda x: x[:, 0], lambda x: x[:, 0] ** 2, lambda x: x.prod(axis=-1)):
        exact = moment(grid) @ density / density.sum()
        assert abs(moment(draws).mean() - exact) < 4 * moment(draws).std() / len(draws) ** 0.5


def test_draws_from_the_prior_have_its_density():
    """The likelihood's mean over the prior is the evidence, here to some percent."""
    rng = np.random.default_rng(7)
    for target in (half_normally_distributed(), gamma_distributed(), bounded(), state_space()):
        likelihood = np.exp(target.log_likelihood(target.prior.sample(40_000, rng)))
        error = likelihood.std() / likelihood.mean() / 200
        assert abs(np.log(likelihood.mean()) - target.log_evidence) < 4 * error < 0.1


def test_noise_has_the_law_of_a_pseudo_marginal_chain():
    target, rng = TwoModes(2), np.random.default_rng(8)
    posterior = target.posterior((4, 10_000), rng, noise_sd=1.0)
    points = posterior.draws.reshape(-1, 2)
    exact = target.log_density(points)
    fresh = posterior.evaluate(points, rng) - exact
    stored = posterior.log_density.ravel() - exact
    # Each is one but for an error of 1.3 / 200.
    assert abs(np.exp(fresh).mean() - 1) < 0.03
    assert abs(np.exp(-stored).mean() - 1) < 0.03
    assert np.corrcoef(fresh, stored)[0, 1] == pytest.approx(0, abs=0.03)


def test_chains_go_to_and_fro_between_the_modes():
    draws = TwoModes(2).posterior((4, 1000), np.random.default_rng(9), correlation=0.8).draws
    sides = draws[..., 0] > 0
    assert (np.abs(np.diff(sides, axis=1)).sum(axis=1) > 100).all()


# A double well: the evidence from pseudo-marginal chains against quadrature over a grid filter.


ESTIMATORS = ["chib_jeliazkov", "bridge", "importance"]
# What `suggest_particles` suggests: a log-likelihood of variance two, between 1 and 3.3.
N_PARTICLES = 50


def test_the_quadrature_has_converged():
    """Of 19 points a side; with 25 the error is a millionth."""
    assert double_well.log_evidence(19) == pytest.approx(double_well.LOG_EVIDENCE, abs=1e-4)


@pytest.mark.slow
def test_the_truth_again():
    assert double_well.log_evidence(49) == pytest.approx(double_well.LOG_EVIDENCE, abs=1e-6)


@pytest.mark.slow
def test_pseudo_marginal_chains_are_within_a_tenth_of_a_nat():
    """Errors are normal: four of them are too few once in 16 000 times."""
    model, quiet = double_well.model(psf.BootstrapPF(N_PARTICLES)), {"progressbar": False}
    idata = psf.sample_dram(20_000, tune=1000, chains=4, model=model, random_seed=2, **quiet)
    found = psf.estimate_evidence(
        idata, model, estimators=ESTIMATORS, target_se=0.1, random_seed=3, **quiet
    )
    for evidence in found.values():
        error = abs(evidence.log_evidence - double_well.LOG_EVIDENCE)
        assert error < 4 * evidence.se
        assert error < 0.1
    assert found.agreement


@pytest.mark.slow
def test_the_number_of_particles_is_the_one_suggested():
    model = double_well.model(psf.BootstrapPF(N_PARTICLES))
    assert psf.suggest_particles(model, random_seed=1).loc["d", "n_particles"] == N_PARTICLES
