"""Kernels of known integral without a prior, for the tests that need none (else: ``targets``)."""

import numpy as np
from scipy.stats import multivariate_normal

from pymc_statespace_filters.evidence.estimators.whitening import NormalProposals
from pymc_statespace_filters.evidence.posterior import Posterior
from tests.evidence.targets import Regression, autoregressive

__all__ = ["Regression", "autoregressive", "gaussian", "half_normal", "pilot"]


def gaussian(k, shape, rng, *, correlation=0.0, noise_sd=0.0, log_evidence=-3.7):
    """Correlated Gaussian posterior; with noise, the exact law of a pseudo-marginal chain.

    Estimates of the likelihood have log-noise N(-sd^2/2, sd^2), so their mean is exact. The chain's
    stationary law tilts that noise by its exponential: stored estimates have N(+sd^2/2, sd^2).
    """
    chol = np.tril(np.ones((k, k))) + np.diag(np.arange(k))
    mean = np.arange(k) - 1.0
    draws = mean + autoregressive((*shape, k), correlation, rng) @ chol.T
    law = multivariate_normal(mean, chol @ chol.T)

    def exact(x):
        return law.logpdf(x) + log_evidence

    def evaluate(x, rng):
        return np.atleast_1d(exact(x)) + rng.normal(-(noise_sd**2) / 2, noise_sd, len(x))

    stored = exact(draws) + rng.normal(noise_sd**2 / 2, noise_sd, shape)
    return Posterior(draws, stored, evaluate, is_noisy=noise_sd > 0)


def half_normal(shape, rng):
    """Half-normal kernel on x > 0 without a transform: log-evidence ln(sqrt(pi / 2))."""
    draws = np.abs(rng.standard_normal((*shape, 1)))

    def evaluate(x, rng):
        return np.where(x[:, 0] > 0, -0.5 * x[:, 0] ** 2, -np.inf)

    return Posterior(draws, -0.5 * draws[..., 0] ** 2, evaluate)


def pilot(posterior):
    """The proposals from which Chib and Jeliazkov's plan is made."""
    return NormalProposals(posterior, [40])
