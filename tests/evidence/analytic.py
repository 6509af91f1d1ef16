"""Posteriors known in closed form, with draws of known autocorrelation: no sampler, no PyMC."""

import numpy as np
from scipy.linalg import solve
from scipy.signal import lfilter
from scipy.stats import multivariate_normal, norm

from pymc_statespace_filters.evidence.posterior import Posterior


def autoregressive(shape, correlation, rng):
    """Standard normals (chain, draw, k) whose lag-one correlation along the draws is as given."""
    innovations = rng.standard_normal(shape)
    innovations[:, 1:] *= np.sqrt(1 - correlation**2)
    return lfilter([1.0], [1.0, -correlation], innovations, axis=1)


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


class Regression:
    """y = X w + N(0, sd^2), w ~ N(0, scale^2): posterior and evidence in closed form."""

    def __init__(self, k, n, rng, *, sd=0.5, scale=2.0):
        self.x = np.column_stack([np.ones(n), rng.standard_normal((n, k - 1))])
        self.y = self.x @ rng.standard_normal(k) + sd * rng.standard_normal(n)
        self.sd, self.scale = sd, scale
        precision = self.x.T @ self.x / sd**2 + np.eye(k) / scale**2
        self.mean = solve(precision, self.x.T @ self.y / sd**2)
        self.chol = np.linalg.cholesky(np.linalg.inv(precision))
        marginal = scale**2 * self.x @ self.x.T + sd**2 * np.eye(n)
        self.log_evidence = multivariate_normal(np.zeros(n), marginal).logpdf(self.y)

    def log_density(self, w):
        residual = self.y - w @ self.x.T
        return norm.logpdf(residual, scale=self.sd).sum(-1) + norm.logpdf(w, scale=self.scale).sum(
            -1
        )

    def posterior(self, shape, rng, *, correlation=0.0):
        z = autoregressive((*shape, len(self.mean)), correlation, rng)
        draws = self.mean + z @ self.chol.T
        return Posterior(draws, self.log_density(draws), lambda w, rng: self.log_density(w))
