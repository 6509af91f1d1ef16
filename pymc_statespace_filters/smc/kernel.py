"""A Metropolis kernel learnt from one population, to move others: walks and independent points."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ..errors import ModelError
from ..statistics.student_mixture import (
    Standardised,
    StudentMixture,
    fit_mixture,
    likeliest_mixture,
    standardised,
)
from .particles import Evaluate, Particles, Populations

ACCEPTANCE = 0.25  # of the random walk, at which it is aimed
SCALES = 0.02, 2.0  # bounds of its length, relative to the optimum for a normal distribution
NUMBERS_OF_COMPONENTS = 1, 2, 4, 8
POINTS_OF_A_COMPONENT = 10  # at least so many times the number of parameters

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Kernel:
    """Half of the proposals are steps of a random walk, the others points of a mixture.

    The walk suits any shape. The mixture, of Student-t distributions, leads from mode to mode, and
    mixes at once where it is close to the target.
    """

    chol: Array  # (k, k), of the covariance of the particles
    mixture: StudentMixture
    scale: float  # of the walk, relative to the optimum for a normal distribution
    screen: Evaluate | None = None  # a cheap likelihood without noise

    def proposals(
        self, x: Array, rng: np.random.Generator
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """A proposal for each point (n, k), the log of q(x | x') / q(x' | x), and which walk."""
        n, k = x.shape
        walks = np.asarray(rng.random(n) < 0.5)
        steps = rng.standard_normal((n, k)) @ self.chol.T * (self.scale * 2.38 / math.sqrt(k))
        proposed = np.where(walks[:, np.newaxis], x + steps, self.mixture.sample(n, rng))
        log_ratio = self.mixture.log_density(x) - self.mixture.log_density(proposed)
        return proposed, np.where(walks, 0.0, log_ratio), walks

    def scaled(self, walk_rate: float) -> Self:
        """With the walk made longer or shorter by the rate at which its steps were accepted."""
        scale = float(np.clip(self.scale * math.exp(walk_rate - ACCEPTANCE), *SCALES))
        return replace(self, scale=scale)


class Rates(NamedTuple):
    """Of acceptance: of the random walk, and of all proposals; how many of these were evaluated."""

    walk: float
    all: float
    n_evaluated: int


def fitted_kernel(
    population: Populations,
    scale: float,
    rng: np.random.Generator,
    screen: Evaluate | None = None,
) -> Kernel:
    """The kernel that moves particles distributed as those of one population.

    Raises `ModelError` if the particles do not vary in every direction.
    """
    x = population.resampled(population.log_weights.shape[1], rng).x
    found = standardised(x)
    if found is None:
        raise ModelError(
            f"draws must be more for {x.shape[1]} parameters: {len(np.unique(x, axis=0))} distinct "
            "particles are left, which do not vary in every direction; raise draws, or narrow the "
            "priors"
        )
    return Kernel(found.chol, fitted_mixture(found, rng), scale, screen)


def fitted_mixture(found: Standardised, rng: np.random.Generator) -> StudentMixture:
    """A mixture of as many components as describe held-out points best, and a wide one."""
    first, second = np.array_split(found.z, 2)
    n, k = found.z.shape
    most = max(1, n // (2 * POINTS_OF_A_COMPONENT * k))
    numbers = [one for one in NUMBERS_OF_COMPONENTS if one <= most]
    mixture = fit_mixture(found.z, likeliest_mixture(first, second, numbers, rng))
    return mixture.with_defensive_component().affine(found.mean, found.chol)


def metropolis(
    particles: Particles,
    kernel: Kernel,
    temperature: float,
    evaluate: Evaluate,
    rng: np.random.Generator,
) -> tuple[Particles, Rates]:
    """Move every particle by a step that leaves the density at a temperature invariant.

    A proposal has noise of its own, whose density cancels. With a screen it is accepted in two
    stages, and evaluated only after the first (Christen and Fox 2005, "Markov chain Monte Carlo
    using an approximation", J. Comput. Graph. Stat. 14, 795-810).
    """
    x, log_ratio, walks = kernel.proposals(particles.x, rng)
    accepted = np.ones(len(x), dtype=bool)
    if kernel.screen is not None:
        before, after = (kernel.screen(at, rng).log_density(temperature) for at in (particles.x, x))
        gain = _difference(after, before)
        accepted = np.log(rng.random(len(x))) < log_ratio + gain
        log_ratio = -gain
    if not accepted.any():
        return particles, Rates(0.0 if walks.any() else ACCEPTANCE, 0.0, 0)
    proposed = evaluate(x[accepted], rng)
    log_ratio = log_ratio[accepted] + _difference(
        proposed.log_density(temperature), particles.log_density(temperature)[accepted]
    )
    n_evaluated, of_evaluated = len(log_ratio), np.log(rng.random(len(log_ratio))) < log_ratio
    accepted[accepted] = of_evaluated
    walk_rate = float(accepted[walks].mean()) if walks.any() else ACCEPTANCE
    rates = Rates(walk_rate, float(accepted.mean()), n_evaluated)
    return particles.moved(accepted, proposed.at(of_evaluated)), rates


def _difference(after: Array, before: Array) -> Array:
    """Of log-densities; NaN, which is not accepted, where both are zero."""
    with np.errstate(invalid="ignore"):
        return after - before
