"""The estimated likelihood of a model, at points of its posterior, for any number of particles."""

import time
from typing import Any, NamedTuple

import numpy as np
from pymc.model import Model

from ...errors import ModelError
from ...filter_checks.checks import doubt_at
from ...filters.protocol import Filter, properties
from ...pymc_model.aligned_axes import records_of_rows
from ...pymc_model.density import RowFunction
from ...pymc_model.graph_rewrites import likelihood_terms, with_filter
from ...pymc_model.inspection import (
    noise_seeds,
    noisy_filters,
    resized,
    state_space_nodes,
)
from ...pymc_model.panel_structure import panel_structure
from ...pymc_model.quieter_filter import quieter_filter
from ..kernel.state import draw_seeds
from ..output.likelihood_variance import TOO_NOISY, SeedSpread, spread_of
from ..target.target import Target
from ..target.variables import RaveledVariables, continuous_value_vars
from .effort import Effort
from .pilot_chain import SETTINGS, Pilot, pilot_chains, run_pilot

# The tail points among the pilot's draws: fractions of the draws of lower density.
_TAIL_FRACTIONS = (0.01, 0.02, 0.03, 0.04, 0.05)
# The best of the pilot's draws, compared by the mean of their estimates.
_N_BEST, _PER_BEST = 5, 12
# Particles of the pilot: least, most, and the most by which they are multiplied.
_PILOT_LEAST, _PILOT_MOST, _PILOT_GROWTH = 200, 1000, 16
# Parts of the limit in seconds after which the first and the second pilot are cut.
_FIRST_SHARE, _SECOND_SHARE = 0.25, 0.5


class Estimates(NamedTuple):
    """Estimates at one point, of which some may be minus infinity, and what they cost."""

    totals: np.ndarray  # (R,)
    terms: np.ndarray  # (R, J), of the likelihood
    seconds: float  # CPU time of one
    records: np.ndarray | None  # (J,), numbers of records of which each moves by itself

    @property
    def spread(self) -> SeedSpread:
        """Moments of the totals, or of the sum of the record that has the largest variance."""
        whole = spread_of(self.totals)
        if self.records is None or not np.isfinite(whole.variance):
            return whole
        sums = np.array([np.bincount(self.records, terms) for terms in self.terms])
        noisiest = max(map(spread_of, sums.T), key=lambda spread: spread.variance)
        return noisiest._replace(mean=whole.mean, n_failed=whole.n_failed)


class NoisyLikelihood:
    """The log-density of a model for any number of particles of one noisy variable."""

    def __init__(
        self, model: Model, var_name: str | None, rng: np.random.Generator, effort: Effort
    ):
        self.name, self.filter = noisy_variable(model, var_name)
        self.pilot_is_complete = True
        self._draws: np.ndarray | None = None  # of the pilot
        self._model, self._rng, self._effort = model, rng, effort
        self._seeds = noise_seeds(model)
        self._point = model.initial_point(random_seed=0)
        self._raveled = RaveledVariables(continuous_value_vars(None, model), self._point)
        if not self._raveled.dim:
            raise ModelError("model must have at least one free variable, it has none")
        self._densities: dict[Filter, RowFunction] = {}
        self._records = _records_moved_alone(model, self.name)

    def points(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """Run the pilot; the centre of the posterior and its tail points, shape (d,) each."""
        n = min(max(self.filter.size(), _PILOT_LEAST), _PILOT_MOST)
        filter = resized(self.filter, n)
        pilot = self._pilot(filter, self._raveled.ravel(self._point), _FIRST_SHARE)
        centre, variance = self._best(filter, pilot)
        quiet = self.quiet_filter() if properties(self.filter).unbiased else None
        if variance > TOO_NOISY and (pilot.is_complete or quiet is not None):
            # The pilot's target was mostly noise.
            filter = quiet or resized(filter, round(n * min(variance, _PILOT_GROWTH)))
            pilot = self._pilot(filter, centre, _SECOND_SHARE)
            centre, _ = self._best(filter, pilot)
        self.pilot_is_complete, self._draws = pilot.is_complete, pilot.positions
        tail = [int(np.argmin(np.abs(pilot.fractions - f))) for f in _TAIL_FRACTIONS]
        return centre, [pilot.positions[i] for i in dict.fromkeys(tail)]

    def quiet_filter(self) -> Filter | None:
        """A filter with little noise that has the same posterior, if the system allows one."""
        return quieter_filter(self._model, self.name)

    def spread(self, n_particles: int, position: np.ndarray, n_seeds: int) -> SeedSpread:
        """Seed spread at a point, with fixed noise of the other variables."""
        return self.estimates(resized(self.filter, n_particles), position, n_seeds).spread

    def estimates(self, filter: Filter, position: np.ndarray, n_seeds: int) -> Estimates:
        """Estimates by a filter, with fixed noise of the other variables."""
        density = self.prepare(filter)
        began = time.process_time()
        seeds = np.tile([int(s.get_value()) for s in self._seeds.values()], (n_seeds, 1))
        seeds[:, list(self._seeds).index(self.name)] = draw_seeds(self._rng, (n_seeds,))
        totals, terms = density.calls(np.tile(position, (n_seeds, 1)), *seeds.T)
        seconds = (time.process_time() - began) / n_seeds
        return Estimates(np.where(totals < np.inf, totals, -np.inf), terms, seconds, self._records)

    def prepare(self, filter: Any) -> RowFunction:
        """Compile what `estimates` evaluates, unless it is there."""
        if filter not in self._densities:
            name = type(filter).__name__
            what = f"{name}, {filter.size()} particles" if filter.noisy else name
            with self._effort.compilation(what):
                self._densities[filter] = self._compiled(filter)
        return self._densities[filter]

    def doubt(self, n_particles: int) -> str | None:
        """What a check at the pilot's draws finds wrong with the estimates beside their noise."""
        if self._draws is None:
            return None
        filter = resized(self.filter, n_particles)
        self._effort.announce("Check of the filter", 1)
        return doubt_at(self._model, self.name, filter, self._draws, self._rng)

    def _compiled(self, filter: Filter) -> RowFunction:
        logp = self._model.logp()
        terms = likelihood_terms(logp, self._model, self.name)
        graph, terms = with_filter([logp, terms], self._model, {self.name: filter})
        density = RowFunction(self._model, graph, [terms])
        density.calls.on_progress = self._effort.advance
        return density

    def _pilot(self, filter: Filter, start: np.ndarray, share: float) -> Pilot:
        self._effort.begin_compilation(f"a chain with {type(filter).__name__}")
        graph = with_filter([self._model.logp()], self._model, {self.name: filter})[0]
        target = Target(self._model, None, SETTINGS, graph=graph)
        return run_pilot(pilot_chains(target, start, self._rng), self._effort, share)

    def _best(self, filter: Filter, pilot: Pilot) -> tuple[np.ndarray, float]:
        """Compare the highest draws by new estimates, as those with fixed noise are too high."""
        self.prepare(filter)
        self._effort.announce("Centre of the posterior", _N_BEST * _PER_BEST)
        points = pilot.positions[:_N_BEST]
        spreads = [self.estimates(filter, x, _PER_BEST).spread for x in points]
        best = int(np.argmax([spread.mean for spread in spreads]))
        return pilot.positions[best], spreads[best].variance


def _records_moved_alone(model: Model, name: str) -> np.ndarray | None:
    """The record of each row of a panel (J,), if no move of a chain needs all its records."""
    structure = panel_structure(model)
    if structure is None or structure.name != name or structure.shared:
        return None
    return records_of_rows(state_space_nodes(model)[name].inputs[3])


def noisy_variable(model: Any, var_name: Any) -> tuple[str, Any]:
    """Give the variable to tune, and its filter."""
    if not isinstance(model, Model):
        raise ModelError(f"model must be a pymc.Model, got {model!r}")
    filters = noisy_filters(model)
    if not filters:
        raise ModelError(
            "model must have a StateSpace variable with a noisy likelihood (particles or an "
            "ensemble), got a model without one"
        )
    listed = ", ".join(map(repr, filters))
    if var_name is None and len(filters) > 1:
        raise ModelError(
            f"var_name must be one of {listed}, as several variables are noisy, got None"
        )
    name = next(iter(filters)) if var_name is None else var_name
    if name not in filters:
        raise ModelError(f"var_name must be a variable with a noisy filter, {listed}, got {name!r}")
    return name, filters[name]
