"""Weighted points of several populations, with what was evaluated at each of them."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ..statistics.importance import log_sum, systematic

Array = NDArray[np.float64]


class Particles(NamedTuple):
    """Points and their log-densities, the populations one behind the other.

    The likelihood of a point has two factors: ``past``, which counts in full, and ``increment``,
    which is raised to a temperature between 0 and 1. ``seeds`` are those of the noise of an
    estimate, and ``states`` what a filter needs to go on from there; both may have no columns.
    """

    x: Array  # (n, k)
    log_prior: Array  # (n,)
    past: Array  # (n,)
    increment: Array  # (n,)
    seeds: NDArray[np.int64]  # (n, number of seeds)
    states: Array  # (n, size of a state), NaN behind a shorter one

    @property
    def log_likelihood(self) -> Array:
        """Of all data, (n,)."""
        return self.past + self.increment

    def log_density(self, temperature: float) -> Array:
        """Prior times likelihood, at a temperature of the second factor; NaN where it is zero."""
        with np.errstate(invalid="ignore"):
            return self.log_prior + self.past + temperature * self.increment

    def at(self, index: NDArray) -> Self:
        """Copies of the particles with these indices, or those that a mask selects."""
        return type(self)(*(values[index] for values in self))

    def moved(self, mask: NDArray[np.bool_], others: Self) -> Self:
        """These particles, with the ``others``, in turn, where the mask says so."""
        merged: list[Any] = []
        for pair in zip(self, others, strict=True):
            old, new = _equally_wide(pair)
            values = old.copy()
            values[mask] = new
            merged.append(values)
        return type(self)(*merged)


def _equally_wide(arrays: Sequence[NDArray]) -> Sequence[NDArray]:
    """Arrays with as many columns as the widest: a state of a filter may be longer than another."""
    widths = {array.shape[1:] for array in arrays}
    if len(widths) == 1:
        return arrays
    ((most,),) = [max(widths)]
    missing = [((0, 0), (0, most - array.shape[1])) for array in arrays]
    return [np.pad(a, m, constant_values=np.nan) for a, m in zip(arrays, missing, strict=True)]


type Evaluate = Callable[[Array, np.random.Generator], Particles]
"""Points (n, k) as particles: their densities, with fresh noise where there is any."""


def interleaved(parts: Sequence[Particles]) -> Particles:
    """The states of many chains, (n,) at each time, as one set in which every chain is in a row."""
    count = len(parts) * len(parts[0].x)
    return Particles(
        *(
            np.stack(columns, axis=1).reshape(count, *columns[0].shape[1:])
            for columns in map(_equally_wide, zip(*parts, strict=True))
        )
    )


class Populations(NamedTuple):
    """R populations of N weighted particles each; the weights of a population sum to one."""

    particles: Particles  # (R * N)
    log_weights: Array  # (R, N)

    @property
    def effective_sizes(self) -> Array:
        """Kish's effective sample size of each population, (R,)."""
        return np.exp(-log_sum(2 * self.log_weights, axis=1))

    @property
    def n_alive(self) -> NDArray[np.int64]:
        """Particles of positive likelihood in each population, (R,)."""
        alive = np.isfinite(self.particles.log_likelihood).reshape(self.log_weights.shape)
        return np.asarray(alive.sum(axis=1))

    @classmethod
    def of_equal_weights(cls, particles: Particles, n_populations: int) -> Self:
        """Populations of equal sizes, one behind the other."""
        size = len(particles.x) // n_populations
        return cls(particles, np.full((n_populations, size), -np.log(size)))

    def raised(self, step: float) -> tuple[Self, Array]:
        """Weighted for a higher temperature; also the log of the mean weight of each population.

        A population whose weights are all zero keeps those that it has: its evidence is zero for
        good.
        """
        increment = self.particles.increment.reshape(self.log_weights.shape)
        alive = np.isfinite(increment)
        gain = np.where(alive, step * np.where(alive, increment, 0.0), -np.inf)
        log_weights = self.log_weights + gain
        log_mean = log_sum(log_weights, axis=1)
        lost = np.isneginf(log_mean)
        log_weights -= np.where(lost, 0.0, log_mean)[:, np.newaxis]
        log_weights[lost] = self.log_weights[lost]
        return type(self)(self.particles, log_weights), log_mean

    def resampled(self, count: int, rng: np.random.Generator) -> Particles:
        """So many particles of each population, by systematic resampling."""
        n_populations, size = self.log_weights.shape
        index = [systematic(weights, count, rng) for weights in np.exp(self.log_weights)]
        places = np.stack(index) + size * np.arange(n_populations)[:, np.newaxis]
        return self.particles.at(places.ravel())
