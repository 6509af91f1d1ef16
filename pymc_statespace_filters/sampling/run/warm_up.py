"""The mixture of proposals that the chains of a model share, through the parts of their warm-up."""

from collections.abc import Sequence

import numpy as np

from ..kernel.independence import no_mixture
from ..kernel.proposal_mixture import fitted_mixture, improved_mixture, warmup_parts
from ..kernel.state import Draws
from ..starts.annealing import N_SWEEPS
from .request import SamplingRequest

_NO_CHAIN = 2**32 - 1


def stops_of(request: SamplingRequest) -> list[int]:
    """Iterations after which the chains wait for each other, in order; last, the end."""
    return [*warmup_parts(request.tune), request.n_iterations]


def generator_of(request: SamplingRequest, *key: int) -> np.random.Generator:
    """A generator of a model's own random numbers, which are not those of a chain."""
    seed = np.random.SeedSequence(request.entropy, spawn_key=(_NO_CHAIN, *key))
    return np.random.default_rng(seed)


class WarmUp:
    """The mixture, fitted to a population and, after each part of the warm-up, to all chains.

    Parameters
    ----------
    request : SamplingRequest
    dim : int
        Of the mixture; 0 for chains that have none.
    population : ndarray, shape (m, d), optional

    Attributes
    ----------
    mixture : ndarray
        Packed, of the current part.
    """

    def __init__(self, request: SamplingRequest, dim: int, population: np.ndarray | None):
        self._request = request
        # The sweeps of a search for starts are nearly the same points; a pilot has one.
        step = N_SWEEPS if request.initvals is None else 1
        self._population = np.empty((0, dim)) if population is None else population[::step]
        fitted = None
        if population is not None:
            fitted = fitted_mixture([population], generator_of(request, 0))
        self.mixture = no_mixture(dim) if fitted is None else fitted
        self._has_mixture = dim > 0

    def end_part(self, chains: Sequence[Draws], end: int) -> int:
        """Fit the mixture to draws up to a stop; the next stop."""
        stops = stops_of(self._request)
        if self._has_mixture:
            self.mixture = improved_mixture(
                self.mixture,
                chains,
                max((stop for stop in stops if stop < end), default=0),
                end,
                generator_of(self._request, end),
                population=self._population,
                tuning=end < self._request.tune,
            )
        return min(stop for stop in stops if stop > end)
