"""How far particles are moved at one temperature: along whole chains, or until they have mixed.

Waste-free (Dau and Chopin 2022, "Waste-free sequential Monte Carlo", J. R. Stat. Soc. B 84,
114-148): few particles are resampled, each starts a chain of Metropolis steps, and all states of
all chains are the new particles. Otherwise as many as there are particles are resampled, moved by
several steps, and only the last states are kept.

The first population, the pilot, learns the length of the steps, and how many they are; the others
follow it. What moves them depends on none of them, so that their evidences are unbiased.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .kernel import Kernel, Rates, metropolis
from .particles import Evaluate, Particles, Populations, interleaved

STARTS = 2.5  # square of the number of chains over that of particles: 50 chains of 1000 particles
# Move until the squared distance from the start grows by less than a fraction of itself.
MIN_MOVES, MAX_MOVES, MIN_GAIN = 2, 50, 0.1

type Step = Callable[[Particles, Kernel], tuple[Particles, Rates]]


@dataclass(frozen=True)
class Size:
    """How many particles a population has, and how many chains they are the states of.

    Without waste the particles are the states of ``n_chains`` chains of ``length``; with waste each
    is a chain whose last state is kept, and the length is learnt.
    """

    n_chains: int
    length: int
    waste_free: bool

    @classmethod
    def of(cls, draws: int, waste_free: bool) -> "Size":
        """Enough for so many draws."""
        if not waste_free:
            return cls(draws, 1, False)
        n_chains = min(draws, math.ceil(math.sqrt(STARTS * draws)))
        return cls(n_chains, math.ceil(draws / n_chains), True)

    @property
    def n_particles(self) -> int:
        """Particles of a population."""
        return self.n_chains * self.length


class Moved(NamedTuple):
    """Populations that were moved, and how: steps, and mean rate of acceptance."""

    populations: Populations
    n_steps: int
    acceptance: float
    n_evaluated: int  # proposals


def move_pilot(
    pilot: Populations,
    kernel: Kernel,
    temperature: float,
    evaluate: Evaluate,
    size: Size,
    rng: np.random.Generator,
) -> tuple[Moved, Kernel]:
    """Move the pilot, and learn the kernel of the others from its steps."""
    if not size.waste_free:
        return _until_mixed(pilot, kernel, temperature, evaluate, rng)
    chain, rates = [pilot.resampled(size.n_chains, rng)], []
    for _ in range(size.length - 1):
        particles, rate = metropolis(chain[-1], kernel, temperature, evaluate, rng)
        kernel = kernel.scaled(rate.walk)
        chain.append(particles)
        rates.append(rate)
    moved = Populations.of_equal_weights(interleaved(chain), 1)
    return Moved(moved, len(rates), *_summary(rates)), kernel


def _until_mixed(
    pilot: Populations,
    kernel: Kernel,
    temperature: float,
    evaluate: Evaluate,
    rng: np.random.Generator,
) -> tuple[Moved, Kernel]:
    """Move the pilot until it hardly moves further away from where it was."""
    start = particles = pilot.resampled(pilot.log_weights.shape[1], rng)
    whiten = np.linalg.inv(kernel.chol).T
    distance, rates = 0.0, []
    for _ in range(MAX_MOVES):
        particles, rate = metropolis(particles, kernel, temperature, evaluate, rng)
        kernel = kernel.scaled(rate.walk)
        rates.append(rate)
        before = distance
        distance = (((particles.x - start.x) @ whiten) ** 2).sum(axis=1).mean()
        if len(rates) >= MIN_MOVES and distance - before < MIN_GAIN * distance:
            break
    moved = Populations.of_equal_weights(particles, 1)
    return Moved(moved, len(rates), *_summary(rates)), kernel


def move_others(
    others: Populations,
    kernel: Kernel,
    n_steps: int,
    temperature: float,
    evaluate: Evaluate,
    size: Size,
    rng: np.random.Generator,
) -> Moved:
    """Move populations by a kernel that they have no part in, by as many steps as the pilot."""
    n_populations, count = others.log_weights.shape
    chain = [others.resampled(size.n_chains if size.waste_free else count, rng)]
    rates = []
    for _ in range(n_steps):
        particles, rate = metropolis(chain[-1], kernel, temperature, evaluate, rng)
        chain.append(particles)
        rates.append(rate)
    kept = interleaved(chain) if size.waste_free else chain[-1]
    moved = Populations.of_equal_weights(kept, n_populations)
    return Moved(moved, n_steps, *_summary(rates))


def _summary(rates: list[Rates]) -> tuple[float, int]:
    """The mean rate of acceptance, and how many proposals were evaluated."""
    mean = float(np.mean([one.all for one in rates])) if rates else math.nan
    return mean, sum(one.n_evaluated for one in rates)
