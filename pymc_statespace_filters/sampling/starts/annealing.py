r"""Anneal a population from one distribution to another, such as from prior to posterior.

With the densities :math:`r` and :math:`r L` of the two, the points pass through the distributions
:math:`r(x) L(x)^\beta`. Each inverse temperature :math:`\beta` is the one at which the effective
number of points has fallen to half; the points are then resampled by :math:`L^{\beta' - \beta}` and
moved by Metropolis steps (Del Moral, Doucet and Jasra 2006, "Sequential Monte Carlo samplers",
J. R. Stat. Soc. B 68, 411-436). At the end they are distributed nearly as the second, over all
modes that the population has met, in proportion to their mass.

Half of the proposals are random walks with the covariance of the population, the others differences
of two of its points (ter Braak 2006, Stat. Comput. 16, 239-249), which follow ridges and lead from
mode to mode. Proposals depend on the points that they move, a bias that starts can bear.

An estimated likelihood is kept with its point, and a proposal gets fresh noise.
"""

import math
from collections.abc import Callable
from itertools import count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import ModelError
from ...smc.temperature import next_temperature
from ...statistics.importance import systematic

# Temperatures; the last of them; its ratio to that of half as many. The ratio is 2 on the way to a
# posterior far away, and grows by factors in many dimensions: 4 of 1800.
_PATIENCE, _LEAST_REACHED, _LEAST_GROWTH = 100, 1e-3, 4.0
_ESS_FRACTION = 0.5  # left by a step of the temperature
_MOVES = 3  # at each temperature
N_SWEEPS = 3  # as many moves again and again, at the last temperature
_ACCEPTANCE = 0.25  # of the moves
_SCALES = 0.02, 2.0  # bounds for their length, relative to the optimum for a Gaussian
_JUMPS, _JITTER = 0.1, 1e-3  # share of whole differences; normal noise on differences, in sd

Array = NDArray[np.float64]
LogDensities = Callable[[Array], tuple[Array, Array]]


class Population(NamedTuple):
    """Points (N, k), log-densities (N,) of the first distribution, and log-ratios to the second."""

    x: Array
    log_first: Array
    log_ratio: Array

    def at(self, index: NDArray[np.int64]) -> "Population":
        """Copies of the points with these indices."""
        return Population(self.x[index], self.log_first[index], self.log_ratio[index])


def anneal(
    population: Population, log_densities: LogDensities, n: int, rng: np.random.Generator
) -> Population:
    """Lead draws of the first distribution to the second.

    ``log_densities`` gives the log-density of the first and the log-ratio at points (m, k). At
    least one draw must have a positive ratio. Gives N_SWEEPS times ``n`` points: the population
    after every third of the last moves. Raises `ModelError` if the distributions lie too far apart.
    """
    temperature, halfway, scale = 0.0, 0.0, 1.0
    for step in count():
        if temperature == 1.0:
            break
        if step == _PATIENCE // 2:
            halfway = temperature
        if step == _PATIENCE and temperature < min(_LEAST_REACHED, _LEAST_GROWTH * halfway):
            raise ModelError(
                "the prior and the data contradict each other: after "
                f"{step} steps from the prior towards the posterior the power of the likelihood is "
                f"{temperature:.1g}, where 1 is the posterior, which must lie a hundred of the "
                "prior's standard deviations away, or more. Compare the units of data and priors, "
                "or give wider priors"
            )
        log_ratio = population.log_ratio
        raised = next_temperature(temperature, log_ratio, _ESS_FRACTION)
        weights = np.exp((raised - temperature) * (log_ratio - log_ratio.max()))
        temperature = raised
        population = population.at(systematic(weights, n, rng))
        sweeps = []
        for _ in range(1 if temperature < 1.0 else N_SWEEPS):
            for _ in range(_MOVES):
                population, rate = _moved(population, temperature, scale, log_densities, rng)
                scale = float(np.clip(scale * math.exp(rate - _ACCEPTANCE), *_SCALES))
            sweeps.append(population)
    return Population(*(np.concatenate(parts) for parts in zip(*sweeps, strict=True)))


def _moved(
    population: Population,
    temperature: float,
    scale: float,
    log_densities: LogDensities,
    rng: np.random.Generator,
) -> tuple[Population, float]:
    """Move every point by a Metropolis step; also the acceptance rate."""
    x, log_first, log_ratio = population
    n, k = x.shape
    spread = x.std(axis=0)
    i, j = rng.integers(n, size=(2, n))
    length = np.where(rng.random(n) < _JUMPS, 1.0, scale * 2.38 / math.sqrt(2 * k))
    difference = length[:, np.newaxis] * (x[i] - x[j])
    difference += _JITTER * spread * rng.standard_normal((n, k))
    # sum of z_l (x_l - mean) / sqrt(n) has the covariance of the population, singular or not
    walk = rng.standard_normal((n, n)) @ (x - x.mean(axis=0)) * (scale * 2.38 / math.sqrt(n * k))
    by_walk = rng.random((n, 1)) < 0.5
    proposed = x + np.where(by_walk, walk, difference)

    new_first, new_ratio = log_densities(proposed)
    with np.errstate(invalid="ignore"):  # zero density at both points: NaN, not accepted
        log_alpha = new_first - log_first + temperature * (new_ratio - log_ratio)
        accepted = np.log(rng.random(n)) < log_alpha
    return Population(
        np.where(accepted[:, np.newaxis], proposed, x),
        np.where(accepted, new_first, log_first),
        np.where(accepted, new_ratio, log_ratio),
    ), float(accepted.mean())
