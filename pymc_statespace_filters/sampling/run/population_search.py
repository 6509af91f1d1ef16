"""The search for starts of a model's chains, and the mixture of proposals that they share."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from pymc.model import Model

from ...errors import ModelError
from ...facts import tell
from ...statistics.student_mixture import standardised
from ..checkpoint.record_file import RecordFile
from ..kernel.independence import no_mixture
from ..kernel.proposal_mixture import fitted_mixture, improved_mixture, warmup_parts
from ..kernel.state import Draws
from ..output.facts import NoisyStarts, SeparateModes
from ..output.likelihood_variance import is_measured
from ..starts.annealing import N_SWEEPS
from ..starts.local_scale import local_cov
from ..starts.population import N_POINTS, find_population
from ..target.target import MANY_DIMENSIONS, Target
from .request import SamplingRequest

_NO_CHAIN = 2**32 - 1
_STARTS = "starts"  # key in the checkpoint

_UNUSABLE_PILOT = (
    "a pilot that lacks free variables of the model needs tune of at least 1, priors that can be "
    "drawn from, no initval in the model, and no correlation"
)
# Iterations of the warm-up of all chains, with an expensive filter: from the first on, the search
# for starts is complete, and below the second there is none. A search makes 200 evaluations, and 24
# to 60 for each point: with as many draws as warm-up, a third of what the chains evaluate, or as
# much for narrow posteriors.
_LONG_WARMUP, _SHORT_WARMUP = 4000, 800
_PER_POINT = 40  # of these iterations
_FEWEST_POINTS = 32
_THIN = 0.3  # draws for each dimension, of which the mixture is fitted to one


def stops_of(request: SamplingRequest) -> list[int]:
    """Iterations after which the chains wait for each other, in order; last, the end."""
    return [*warmup_parts(request.tune), request.n_iterations]


def generator_of(request: SamplingRequest, *key: int) -> np.random.Generator:
    """A generator of a model's own random numbers, which are not those of a chain."""
    seed = np.random.SeedSequence(request.entropy, spawn_key=(_NO_CHAIN, *key))
    return np.random.default_rng(seed)


class WarmUp:
    """The mixture, fitted to a population and, after each part of the warm-up, to all chains.

    The population (m, d) may be None; ``dim`` is that of the mixture, 0 for chains that have none,
    and ``mixture`` is packed, of the current part.
    """

    def __init__(
        self, request: SamplingRequest, dim: int, population: np.ndarray | None, *, is_noisy: bool
    ):
        self._request, self._is_noisy = request, is_noisy
        # In many dimensions a chain of a thousand iterations has few independent draws, and the
        # population has settled. Else the sweeps of a search are nearly the same points; a pilot
        # has one.
        is_many = dim >= MANY_DIMENSIONS and population is not None
        step = 1 if is_many or request.initvals is not None else N_SWEEPS
        self._thin = round(_THIN * dim) if is_many else 1
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
                thin=self._thin,
                tuning=end < self._request.tune,
                is_noisy=self._is_noisy,
            )
        return min(stop for stop in stops if stop > end)


class SearchedPoints(NamedTuple):
    """Points of the posterior (m, d), if there are, and their median log-density, if it is known.

    ``is_noisy`` tells whether a warning has said that the likelihood is too noisy there.
    """

    x: np.ndarray | None = None
    level: float = -np.inf
    is_noisy: bool = False


def search_population(
    model: Model,
    target: Target,
    request: SamplingRequest,
    checkpoint: RecordFile | None,
    begin: str,
    *,
    progressbar: bool,
) -> SearchedPoints:
    """Points of the posterior, stored in the checkpoint; none if starts are given otherwise.

    None with a short warm-up of an expensive filter, too, and if the noise is carried. A pilot that
    lacks no variable has the points itself. ``begin`` is the beginning of messages. Raises
    `ModelError` if no points can be found, though the pilot needs some.
    """
    pilot = None if request.pilot is None else np.array(request.pilot, dtype=np.float64)
    if pilot is not None and np.isfinite(pilot).all():
        return SearchedPoints(pilot)
    n_points = n_search_points(request, target)
    if (
        n_points == 0
        or request.initvals is not None
        or not target.prior_draws.may_start
        or target.carries_noise
    ):
        if pilot is not None:
            raise ModelError(begin + _UNUSABLE_PILOT)
        return SearchedPoints()
    if checkpoint is not None and (stored := checkpoint.read(_STARTS)) is not None:
        return SearchedPoints(stored.draws["population"], float(stored.state["level"]))
    try:
        found = find_population(
            target,
            generator_of(request),
            progressbar=progressbar,
            n_points=n_points,
            pilot=pilot,
        )
    except Exception as error:
        error.add_note(begin + "in the search for starts")
        raise
    tell(SeparateModes(model, target.raveled, found, before_run=True), begin)
    level, noise = float(np.median(found.log_density)), []
    if checkpoint is not None:
        checkpoint.append(_STARTS, {"population": found.x}, {"level": np.array(level)})
    if is_measured(target, request.n_iterations):
        noise = tell(NoisyStarts(model, target, found, generator_of(request, 0, 1)), begin)
    return SearchedPoints(found.x, level, bool(noise))


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


def first_cov(
    request: SamplingRequest, target: Target, population: np.ndarray | None, start: np.ndarray
) -> np.ndarray | None:
    """The first proposal covariance: of the population, or where the user starts a chain.

    None if it is the user's, or the prior's, which may be a thousand times too wide.
    """
    if request.proposal_cov is not None:
        return None
    if request.initvals is not None:
        return local_cov(target, start)
    if population is None:
        return None
    points = standardised(population)
    if points is None:
        return None
    return np.asarray(points.chol @ points.chol.T * 2.38**2 / population.shape[1])
