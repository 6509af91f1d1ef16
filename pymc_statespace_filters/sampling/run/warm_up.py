"""The mixture of proposals that the chains of a model share, through the parts of their warm-up."""

from collections.abc import Sequence

import numpy as np

from pymc_statespace_filters.sampling.kernel.independence import no_mixture
from pymc_statespace_filters.sampling.kernel.proposal_mixture import (
    fitted_mixture,
    improved_mixture,
    warmup_parts,
)
from pymc_statespace_filters.sampling.kernel.state import Draws
from pymc_statespace_filters.sampling.run.request import SamplingRequest
from pymc_statespace_filters.sampling.starts.annealing import N_SWEEPS
from pymc_statespace_filters.sampling.starts.population import N_POINTS
from pymc_statespace_filters.sampling.target.target import Target
from pymc_statespace_filters.student_mixture import standardised

_NO_CHAIN = 2**32 - 1
# Iterations of the warm-up of all chains, with an expensive filter: from the first on, the search
# for starts is complete, and below the second there is none. A search makes 200 evaluations, and 24
# to 60 for each point: with as many draws as warm-up, a third of what the chains evaluate, or as
# much for narrow posteriors.
_LONG_WARMUP, _SHORT_WARMUP = 4000, 800
_PER_POINT = 40  # of these iterations
_FEWEST_POINTS = 32


def stops_of(request: SamplingRequest) -> list[int]:
    """Iterations after which the chains wait for each other, in order; last, the end."""
    return [*warmup_parts(request.tune), request.n_iterations]


def n_search_points(request: SamplingRequest, target: Target) -> int:
    """Points of the search for starts; 0 if there is no search.

    Fewer with an expensive filter and a short warm-up: then a search would take longer than the
    chains. The number of draws does not count, so that a long run contains every shorter one. A
    pilot that lacks variables needs a search, however short.
    """
    iterations = request.chains * request.tune
    if iterations == 0:
        return 0
    if iterations >= _LONG_WARMUP or not target.is_expensive:
        return N_POINTS
    if iterations < _SHORT_WARMUP and request.pilot is None:
        return 0
    return max(iterations // _PER_POINT, _FEWEST_POINTS)


def generator_of(request: SamplingRequest, *key: int) -> np.random.Generator:
    """A generator of a model's own random numbers, which are not those of a chain."""
    seed = np.random.SeedSequence(request.entropy, spawn_key=(_NO_CHAIN, *key))
    return np.random.default_rng(seed)


def searched_cov(
    request: SamplingRequest, target: Target, population: np.ndarray | None
) -> np.ndarray | None:
    """The first proposal covariance after a short search; None if it is the user's or the prior's.

    A mixture fitted to few points may suit none, and the prior may be a thousand times too wide.
    """
    is_complete = n_search_points(request, target) == N_POINTS
    if population is None or request.proposal_cov is not None or is_complete:
        return None
    points = standardised(population)
    if points is None:
        return None
    return np.asarray(points.chol @ points.chol.T * 2.38**2 / population.shape[1])


class WarmUp:
    """The mixture, fitted to a population and, after each part of the warm-up, to all chains.

    Parameters
    ----------
    request : SamplingRequest
    dim : int
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

    def end_part(self, chains: Sequence[Draws], end: int) -> int:
        """Fit the mixture to draws up to a stop; the next stop."""
        stops = stops_of(self._request)
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
