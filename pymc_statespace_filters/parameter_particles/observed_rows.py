"""The likelihood row by row, of a model whose data are one record of a StateSpace variable."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pytensor.graph.traversal import ancestors

from ..errors import ModelError
from ..filters.protocol import Filter
from ..pymc_model.at_points import GraphsAtPoints
from ..pymc_model.filter_rows import FilterRows, Record
from ..pymc_model.inspection import resized
from ..pymc_model.prior import ModelPrior
from ..pymc_model.state_space_variable import (
    StateSpaceVariable,
    observed_variables,
    with_other_filter,
)
from ..smc.particles import Evaluate, Particles
from ..system.clock import Clock

Array = NDArray[np.float64]
_LARGEST_SEED = np.iinfo(np.int64).max


@dataclass(frozen=True)
class ObservedRows:
    """A model as a prior and one factor of the likelihood for each row of its record.

    ``screen`` is a cheap filter by which moves are screened, if there is one.
    """

    model: pm.Model
    variable: StateSpaceVariable
    record: Record
    filter: Filter
    screen: Filter | None = None

    @classmethod
    def of(cls, model: pm.Model, screen: Filter | None = None) -> Self:
        """Read a model; a `ModelError` if its data do not come row by row."""
        variable = _only_variable(model)
        if screen is not None:
            _check_filter(with_other_filter(variable, screen))
        record = variable.steps, variable.observed, variable.inputs, variable.t0
        values = (graph.eval(mode="FAST_COMPILE") for graph in record)
        return cls(model, variable, Record(*map(np.asarray, values)), variable.filter, screen)

    def with_record(self, record: Record) -> Self:
        """The same model of another record."""
        return replace(self, record=record)

    def with_clock(self, clock: Clock) -> Self:
        """The same model with dates that count from elsewhere."""
        return replace(self, variable=self.variable._replace(clock=clock))

    def of_size(self, n_members: int) -> Self:
        """The same with a filter of another number of members."""
        return replace(self, filter=resized(self.filter, n_members))

    @property
    def seen_times(self) -> Array:
        """The times of the rows, as numbers of the model."""
        system, record = self.variable.system, self.record
        if not system.is_at_any_times:
            return np.asarray(record.t0 + record.steps * system.dt)
        starts, lengths = record.inputs[:, system.n_inputs + 1], record.inputs[:, system.n_inputs]
        ends = np.append(starts, starts[-1:] + lengths[-1:])
        return np.asarray(ends[record.steps])

    @property
    def shown_times(self) -> Any:
        """The same as the user gave them: numbers or dates."""
        return self.variable.clock.shown(self.seen_times)

    @cached_property
    def prior(self) -> ModelPrior:
        """The prior of the parameters."""
        return ModelPrior(self.model)

    @cached_property
    def _theta(self) -> GraphsAtPoints:
        return GraphsAtPoints(self.model, [self.variable.theta])

    def parameters(self, x: Array) -> Array:
        """The parameters of the system (m, n_theta) at points x (m, k)."""
        (theta,) = self._theta(x)
        return np.ascontiguousarray(theta, dtype=np.float64)

    @cached_property
    def _run(self) -> FilterRows:
        return FilterRows(self.variable.system, self.filter)

    def seeds(self, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """Fresh seeds (count, 1) of a noisy filter; none (count, 0) of another."""
        return rng.integers(_LARGEST_SEED, size=(count, int(self.filter.noisy)))

    def filtered(
        self, x: Array, seeds: NDArray[np.int64], states: Array, begin: int, end: int
    ) -> tuple[Array, Array]:
        """Terms (m, rows) of some rows at points, 0 where they do not count, and new states."""
        rows = self.record.rows(begin, end)
        terms, after = self._run(self.parameters(x), _one(seeds), states, rows)
        terms = np.where(np.isnan(terms), -np.inf, terms)
        n_unscored = max(0, self.variable.score_from - begin)
        failed = np.isneginf(terms[:, :n_unscored]).any(axis=1)
        terms[:, :n_unscored] = np.where(failed, -np.inf, 0.0)[:, np.newaxis]
        return terms, after

    def drawn_before(self, particles: Particles, row: int, rng: np.random.Generator) -> Array:
        """A state (m, n) at a row, drawn given the rows before it; NaN where that has failed."""
        unseen = np.full_like(self.record.observed, np.nan)
        rows = self.record._replace(observed=unseen).rows(row, row + 1)
        theta, seeds = self.parameters(particles.x), _one(particles.seeds)
        _, after = self._run(theta, seeds, particles.states, rows)
        return self._run.law_of_state(after).drawn(rng)

    def drawn(self, count: int, rng: np.random.Generator) -> Particles:
        """Draws of the prior, before any row."""
        x = self.prior.sample(count, rng)
        nothing, none = np.zeros(count), np.empty((count, 0))
        seeds = self.seeds(count, rng)
        return Particles(x, self.prior.log_density(x), nothing, nothing, seeds, none)

    def with_row(self, particles: Particles, row: int) -> Particles:
        """Particles with the factor of one more row, by one update of each filter."""
        past = particles.log_likelihood
        alive = np.isfinite(past)
        known = particles if alive.all() else particles.at(alive)
        terms, after = self.filtered(known.x, known.seeds, known.states, row, row + 1)
        if known is particles:
            return particles._replace(past=past, increment=terms[:, 0], states=after)
        increment, new = np.full(len(past), -np.inf), np.full((len(past), after.shape[1]), np.nan)
        increment[alive], new[alive] = terms[:, 0], after
        return particles._replace(past=past, increment=increment, states=new)

    def at_row(self, row: int) -> Evaluate:
        """The function of points that gives particles with the factor of one row."""

        def evaluate(x: Array, rng: np.random.Generator) -> Particles:
            seeds, log_prior = self.seeds(len(x), rng), self.prior.log_density(x)
            terms, states = self.filtered(x, seeds, np.empty((len(x), 0)), 0, row + 1)
            return Particles(x, log_prior, terms[:, :-1].sum(axis=1), terms[:, -1], seeds, states)

        return evaluate

    def screen_at_row(self, row: int) -> Evaluate | None:
        """The same by the screen; None without one."""
        return None if self.screen is None else replace(self, filter=self.screen).at_row(row)

    def estimated(
        self, x: Array, n_rows: int, rng: np.random.Generator
    ) -> tuple[Array, NDArray[np.int64], Array]:
        """Log-likelihoods of the first rows at points with fresh noise, its seeds, and states."""
        seeds = self.seeds(len(x), rng)
        terms, states = self.filtered(x, seeds, np.empty((len(x), 0)), 0, n_rows)
        return terms.sum(axis=1), seeds, states


def _one(seeds: NDArray[np.int64]) -> NDArray[np.int64]:
    """The seed of each run; 0 of a filter without noise."""
    return seeds[:, 0] if seeds.shape[1] else np.zeros(len(seeds), np.int64)


def exchanged(
    rows: ObservedRows, particles: Particles, n_rows: int, rng: np.random.Generator
) -> Particles:
    """Particles whose factor is the ratio of new estimates of the likelihood to theirs."""
    past = particles.log_likelihood
    new, seeds, states = rows.estimated(particles.x, n_rows, rng)
    with np.errstate(invalid="ignore"):
        increment = np.where(np.isfinite(past), new - past, -np.inf)
    return particles._replace(past=past, increment=increment, seeds=seeds, states=states)


def exchanging(old: ObservedRows, new: ObservedRows, n_rows: int) -> Evaluate:
    """The function of points that gives particles with that ratio as their factor."""

    def evaluate(x: Array, rng: np.random.Generator) -> Particles:
        past, seeds, states = old.estimated(x, n_rows, rng)
        nothing = np.zeros(len(x))
        before = Particles(x, old.prior.log_density(x), past, nothing, seeds, states)
        return exchanged(new, before, n_rows, rng)

    return evaluate


def _only_variable(model: pm.Model) -> StateSpaceVariable:
    """The variable whose record comes row by row."""
    variables = observed_variables(model)
    others = [rv.name for rv in model.observed_RVs if rv.name not in {v.name for v in variables}]
    others += [potential.name for potential in model.potentials]
    if len(variables) != 1 or others:
        names = [v.name for v in variables] + others
        _refuse(f"the data of one StateSpace variable alone, got {names or 'none'}")
    (variable,) = variables
    if variable.is_panel:
        _refuse(f"a single record, got a panel in {variable.name!r}")
    _check_filter(variable)
    free = {rv for rv in model.free_RVs}
    named = {"steps": variable.steps, "inputs": variable.inputs, "t0": variable.t0}
    if moving := [name for name, graph in named.items() if free & set(ancestors([graph]))]:
        _refuse(f"{' and '.join(moving)} that do not depend on free variables")
    return variable


def _check_filter(variable: StateSpaceVariable) -> None:
    filter: Any = variable.filter
    if filter.noisy and variable.score_from:
        _refuse(
            f"score_from=0 with a noisy filter, got {variable.score_from}: the estimate of the "
            "later rows alone is not unbiased"
        )


def _refuse(what: str) -> None:
    raise ModelError(f"data='sequential' needs {what}; use data='tempered'")
