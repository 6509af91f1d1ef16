"""The largest likelihood, for the information criteria."""

import numpy as np

from pymc_statespace_filters.evidence._means import log_mean_of_independent
from pymc_statespace_filters.evidence.posterior import Posterior

N_REPEATS = N_EVALUATIONS = 100


def max_log_likelihood(posterior: Posterior, rng: np.random.Generator) -> float:
    """Largest log-likelihood met; with a noisy one, an average of estimates at the mean draw."""
    assert posterior.prior is not None
    draws = posterior.draws.reshape(-1, posterior.draws.shape[-1])
    if not posterior.is_noisy:
        log_prior = posterior.prior.log_density(draws)
        return float((posterior.log_density.ravel() - log_prior).max())
    # The largest of many noisy values would be the luckiest.
    centre = np.repeat(draws.mean(axis=0)[np.newaxis], N_REPEATS, axis=0)
    log_density = log_mean_of_independent(posterior.evaluate(centre, rng)).value
    return log_density - float(posterior.prior.log_density(centre[:1])[0])
