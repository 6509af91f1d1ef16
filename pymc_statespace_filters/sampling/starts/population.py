"""A population of points in the posterior, led there from the prior."""

import numpy as np

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.pymc_model.prior import ModelPrior
from pymc_statespace_filters.sampling.starts.annealing import LogDensities, Population, anneal

N_POINTS = 256
_N_DRAWS = 8 * N_POINTS  # most draws of the prior, if few have a positive likelihood


def posterior_population(
    prior: ModelPrior, log_densities: LogDensities, rng: np.random.Generator
) -> Population:
    """`N_POINTS` points that are distributed nearly as the posterior.

    ``log_densities`` gives log prior and log-likelihood of points (m, k).

    Raises
    ------
    ModelError
        If the prior cannot be sampled, or no draw of it has a positive likelihood.
    """
    return anneal(_drawn_population(prior, log_densities, rng), log_densities, N_POINTS, rng)


def _drawn_population(
    prior: ModelPrior, log_densities: LogDensities, rng: np.random.Generator
) -> Population:
    """Draws of the prior, more of them if few have a positive likelihood."""
    x = prior.sample(N_POINTS, rng)
    population = Population(x, *log_densities(x))
    while np.isfinite(population.log_likelihood).sum() < N_POINTS // 4:
        if len(population.x) >= _N_DRAWS:
            break
        x = prior.sample(N_POINTS, rng)
        parts = zip(population, Population(x, *log_densities(x)), strict=True)
        population = Population(*map(np.concatenate, parts))
    if not np.isfinite(population.log_likelihood).any():
        raise ModelError(
            f"the likelihood is zero at all of {len(population.x)} draws of the prior: narrow the "
            "priors to plausible values"
        )
    return population
