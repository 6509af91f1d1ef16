"""The mean likelihood of draws of the prior."""

from dataclasses import replace

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.estimators.prior_monte_carlo import PriorMonteCarlo
from pymc_statespace_filters.evidence.estimators.smc_moves import sample_prior_particles
from pymc_statespace_filters.evidence.posterior_of_draws import build_posterior
from pymc_statespace_filters.pymc_model.density import ModelDensity
from tests.evidence.targets import Regression, TwoModes, bounded, half_normally_distributed

TARGETS = {
    "regression": Regression(2, 4, np.random.default_rng(70), sd=1.5),
    "two modes": TwoModes(1),
    "half-normal": half_normally_distributed(),
    "bounded": bounded(),
}


@pytest.mark.parametrize("noise_sd", [0.0, 1.0])
@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS)
def test_unbiased_with_an_honest_error(target, noise_sd):
    # For 200 standard normal scores the bounds hold with probability above 0.9995.
    posterior = target.posterior((2, 20), np.random.default_rng(71), noise_sd=noise_sd)
    scores = []
    for run in range(200):
        found = PriorMonteCarlo(5000).estimate(posterior, rng=np.random.default_rng([75, run]))
        assert not found.doubts
        scores.append((found.log_evidence - target.log_evidence) / found.se)
    assert abs(np.mean(scores)) < 0.25
    assert 0.7 < np.mean(np.square(scores)) < 1.4


def test_the_prior_does_not_count_twice():
    """As Eq. 3.6 is printed: two nats too low here, ten standard errors."""
    target = TARGETS["regression"]
    posterior = target.posterior((2, 20), np.random.default_rng(73))
    twice = replace(
        posterior,
        evaluate=lambda x, rng: posterior.evaluate(x, rng) + target.prior.log_density(x),
    )
    found = PriorMonteCarlo().estimate(twice, rng=np.random.default_rng(74))
    assert abs(found.log_evidence - target.log_evidence) > 10 * found.se


def test_draws_without_likelihood_count_as_zeros():
    """A likelihood of one on half the prior, and of zero on the other."""

    class Uniform:
        def log_density(self, x):
            return np.where(np.abs(x[:, 0]) < 1, -np.log(2), -np.inf)

        def sample(self, count, rng):
            return rng.uniform(-1, 1, (count, 1))

    posterior = replace(
        TARGETS["bounded"].posterior((2, 20), np.random.default_rng(75)),
        prior=Uniform(),
        evaluate=lambda x, rng: np.where(x[:, 0] > 0, -np.log(2), -np.inf),
    )
    found = PriorMonteCarlo(10_000).estimate(posterior, rng=np.random.default_rng(76))
    assert found.se == pytest.approx(0.01, rel=0.05)
    assert abs(found.log_evidence - np.log(0.5)) < 4 * found.se
    # As many draws count as have a likelihood.
    n_effective = found.settings["n_effective_prior_draws"]
    assert n_effective == pytest.approx(10_000 * np.exp(found.log_evidence))


def test_too_many_parameters_are_a_doubt():
    rng = np.random.default_rng(77)
    found = PriorMonteCarlo().estimate(Regression(8, 40, rng).posterior((2, 20), rng), rng=rng)
    assert "draws of the prior, fewer than 100" in found.doubts[0]


def test_a_likelihood_that_is_nowhere():
    posterior = replace(
        TARGETS["bounded"].posterior((2, 20), np.random.default_rng(78)),
        evaluate=lambda x, rng: np.full(len(x), -np.inf),
    )
    with pytest.raises(ModelError, match="likelihood is zero at all 10000 draws of the prior"):
        PriorMonteCarlo().estimate(posterior, rng=np.random.default_rng(79))


def test_a_likelihood_of_zero_is_explained():
    """A variance whose prior is negative: no prior of it is too wide."""
    system = psf.StateSpaceModel(
        lambda x, q: [0.9 * x[0] + q[0]], lambda x: [x[0]], process_noise=[[1.0]],
        observation_noise=lambda v: [[v]], initial_mean=[0.0], initial_cov=[[1.0]],
    )  # fmt: skip
    with pm.Model() as model:
        pm.Normal("v", -5.0, 1.0)
        psf.StateSpace("d", system, psf.EKF(), steps=[1, 2], observed=[0.5, -1.0])
        idata = psf.sample_dram(60, tune=60, chains=2, initvals={"v": 1.0}, progressbar=False)
    posterior, _ = build_posterior(idata, ModelDensity(model))
    because = "in 100 of 100 evaluations observation_noise is not positive semidefinite"
    with pytest.raises(ModelError, match=f"at all 100 draws of the prior: {because}"):
        PriorMonteCarlo(100).estimate(posterior, rng=np.random.default_rng(1))
    with pytest.raises(ModelError, match=f"positive at 0 of 100 .*: {because}"):
        sample_prior_particles(posterior, 100, np.random.default_rng(1))
