"""The two factors of a log-density: prior and likelihood."""

import numpy as np
from numpy.typing import NDArray

from pymc_statespace_filters.evidence.posterior import Posterior, Prior

Array = NDArray[np.float64]


def prior_of(posterior: Posterior) -> Prior:
    """The prior, for estimators that cannot do without."""
    assert posterior.prior is not None, "a posterior without a prior"
    return posterior.prior


def log_likelihood_of(log_density: Array, log_prior: Array) -> Array:
    """What the prior leaves; minus infinity where there is no density, whatever the prior there."""
    there = np.isfinite(log_density)
    return np.subtract(log_density, log_prior, out=np.full_like(log_density, -np.inf), where=there)


def evaluate_factors(
    posterior: Posterior, x: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Log prior and log likelihood of points x (m, k), each of shape (m,).

    A noisy likelihood is estimated with fresh noise for each point.
    """
    log_prior = prior_of(posterior).log_density(x)
    return log_prior, log_likelihood_of(posterior.evaluate(x, rng), log_prior)
