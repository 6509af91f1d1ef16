"""A state-space variable at draws of the posterior: parameters, inputs, and estimated states."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.graph.basic import Variable
from pytensor.graph.replace import clone_replace
from pytensor.graph.traversal import ancestors

from pymc_statespace_filters.compiler.native.parallel_map import ParallelMap
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evaluation.simulate import observer
from pymc_statespace_filters.progress import row_progress
from pymc_statespace_filters.pymc_model.inspection import panel_variables
from pymc_statespace_filters.pymc_model.state_graphs import (
    StateSpaceVariable,
    observed_variables,
    states_of,
    term_health_of,
    with_other_filter,
)
from pymc_statespace_filters.states.draws import PosteriorDraws
from pymc_statespace_filters.system.accumulators import (
    inputs_of_user,
    n_input_rows,
    with_resets,
)

Array = NDArray[np.float64]


class States(NamedTuple):
    """Mean, sd and a draw of the state (draws, R, n), and effective sample size (draws, R).

    ``health`` (draws, 3) are the outcomes of the filter, with the noise of ``seeds`` (draws,).
    """

    mean: Array
    sd: Array
    drawn: Array
    n_effective: Array
    health: Array
    seeds: NDArray[np.int64]


class TermHealthAtDraws(NamedTuple):
    """Effective number behind every term (draws, J), and what `States` says of it."""

    n_effective: Array
    health: Array
    seeds: NDArray[np.int64]


class VariableAtDraws:
    """Evaluate graphs of one variable at draws of its model's posterior."""

    def __init__(
        self, model: pm.Model, variable: StateSpaceVariable, draws: PosteriorDraws
    ) -> None:
        self.variable = variable
        self._draws = draws
        # Stop at variables of the model: free ones are replaced by their draws.
        known = set(ancestors([variable.theta, variable.inputs], blockers=model.basic_RVs))
        free = [rv for rv in model.free_RVs if rv in known]
        shapes = model.eval_rv_shapes()
        self._columns = [draws.values(rv.name, tuple(map(int, shapes[rv.name]))) for rv in free]
        # Draws are passed as float64, whatever the type of the variable.
        self._symbols = [pt.tensor(rv.name, dtype="float64", shape=rv.type.shape) for rv in free]
        self._replaced = {rv: model.rvs_to_values[rv] for rv in model.observed_RVs if rv in known}
        self._replaced |= {
            rv: pt.cast(symbol, rv.dtype) for rv, symbol in zip(free, self._symbols, strict=True)
        }
        steps, t0 = pytensor.function([], [variable.steps, variable.t0], mode="FAST_COMPILE")()
        self.steps, self.t0 = np.asarray(steps, dtype=np.int64), float(t0)

    def times(self, rows: NDArray[np.int64]) -> Array:
        """Times of the given steps."""
        return np.asarray(self.t0 + rows * self.variable.system.dt, dtype=np.float64)

    def parameters(self) -> Array:
        """Flat parameters at every draw, (draws, k)."""
        return self._interpret(self.variable.theta)

    def inputs(self) -> Array:
        """Input rows at every draw, (draws or 1, rows, n_input_columns)."""
        graph = self.variable.inputs
        if set(self._replaced) & set(ancestors([graph])):
            return self._interpret(graph)
        return pytensor.function([], graph, mode="FAST_COMPILE")()[None]

    def inputs_until(self, steps: NDArray[np.int64]) -> Array:
        """The same, for observations at `steps` instead; checked to have the rows they need."""
        system = self.variable.system
        rows = inputs_of_user(system, self.inputs())
        if len(rows[0]) < n_input_rows(system, steps) and system.n_inputs:
            raise ModelError(
                f"the model's inputs end after {len(rows[0])} rows, and step {steps[-1]} needs "
                f"{n_input_rows(system, steps)}: give inputs= for all steps, from step 0 on"
            )
        return with_resets(system, rows, steps)

    def _interpret(self, graph: Variable) -> Array:
        # Microseconds for each draw: machine code would take longer to compile than it saves.
        with pytensor.config.change_flags(mode="FAST_COMPILE"):
            return self.evaluate([graph], {})[0]

    def states(
        self, moment: str, rows: NDArray[np.int64], rng: np.random.Generator, *, progressbar: bool
    ) -> States:
        """States at steps `rows`, with the noise of each draw's likelihood estimate.

        Fresh noise is used where no seed is stored.
        """
        seed, draw_seed, row_steps = pt.lscalar("seed"), pt.lscalar("draw_seed"), pt.lvector("rows")
        graphs = states_of(self.variable._replace(seed=seed), moment, row_steps, draw_seed)
        drawn = {seed: self._seeds(rng), draw_seed: self._fresh_seeds(rng)}
        mean, sd, state, n_effective, health = self.evaluate(
            graphs, drawn, {row_steps: rows}, progressbar=progressbar
        )
        return States(mean, sd, state, n_effective, health, drawn[seed])

    def term_health(self, rng: np.random.Generator, *, progressbar: bool) -> TermHealthAtDraws:
        """How many members are behind every term, with the noise of each draw's estimate."""
        seed, seeds = pt.lscalar("seed"), self._seeds(rng)
        graphs = term_health_of(self.variable._replace(seed=seed))
        n_effective, health = self.evaluate(
            graphs, {seed: seeds}, task="health", progressbar=progressbar
        )
        return TermHealthAtDraws(n_effective, health, seeds)

    def arguments_of(self, seeds: NDArray[np.int64]) -> Callable[[int], tuple[Any, ...]]:
        """The function of a draw's number: all inputs of a likelihood with the noise of ``seeds``.

        They are evaluated when it is called.
        """

        def arguments(i: int) -> tuple[Any, ...]:
            rows = self.inputs()
            observed = self.variable.observed.eval(mode="FAST_COMPILE")
            inputs = rows[i if len(rows) > 1 else 0]
            return self.parameters()[i], self.steps, observed, inputs, self.t0, seeds[i]

        return arguments

    def _seeds(self, rng: np.random.Generator) -> NDArray[np.int64]:
        """The seed of each draw's estimate; a fresh one where none is stored or read."""
        stored = (
            self._draws.stored_seeds(self.variable.name) if self.variable.filter.noisy else None
        )
        return self._fresh_seeds(rng) if stored is None else stored

    def _fresh_seeds(self, rng: np.random.Generator) -> NDArray[np.int64]:
        return rng.integers(np.iinfo(np.int64).max, size=int(np.prod(self._draws.shape)))

    def evaluate(
        self,
        graphs: Sequence[Variable],
        drawn: Mapping[Variable, np.ndarray],
        constant: Mapping[Variable, np.ndarray] | None = None,
        *,
        task: str = "states",
        progressbar: bool = False,
    ) -> list[Array]:
        """Evaluate graphs at every draw; `drawn` inputs vary over draws, `constant` ones do not."""
        constant = constant or {}
        bound = clone_replace(list(graphs), self._replaced)
        # The index of the draw makes sure that there is at least one varying input.
        inputs = [pt.lscalar("number"), *self._symbols, *drawn, *constant]
        function = pytensor.function(inputs, bound, on_unused_input="ignore", trust_input=True)
        columns = [np.arange(np.prod(self._draws.shape)), *self._columns, *drawn.values()]
        calls = ParallelMap(function, [column[0] for column in columns], list(constant.values()))
        with row_progress(calls, enabled=progressbar) as begin:
            begin(task, len(columns[0]))
            results = calls(*columns)
        ends = np.cumsum([int(np.prod(shape)) for shape in calls.shapes])[:-1]
        parts = np.split(results, ends, axis=1)
        return [part.reshape(-1, *shape) for part, shape in zip(parts, calls.shapes, strict=True)]


def simulate_observations(
    at_draws: VariableAtDraws,
    states: Array,
    steps: NDArray[np.int64],
    rows: Array,
    rng: np.random.Generator,
) -> Array:
    """Simulate an observation (draws, R, p) of each state (draws, R, n); NaN where that is NaN."""
    system, theta = at_draws.variable.system, at_draws.parameters()
    observe = observer(system).function
    simulated = np.full((*states.shape[:2], system.p), np.nan)
    for i, path in enumerate(states):
        known = np.isfinite(path).all(axis=1)
        inputs = rows[i if len(rows) > 1 else 0]
        simulated[i, known] = observe(rng, theta[i], path[known], steps[known], inputs, at_draws.t0)
    return simulated


def select_variables(
    model: pm.Model, name: str | None, filter: Any = None
) -> list[StateSpaceVariable]:
    """The observed variable of a name, or all of them, optionally with another filter."""
    found = {variable.name: variable for variable in observed_variables(model)}
    if not found:
        raise ModelError("model must have an observed StateSpace variable, got none")
    if name is not None and name not in list(found):  # `in found` fails for unhashable names
        raise ModelError(f"var_name must be one of {list(found)}, got {name!r}")
    chosen = list(found.values()) if name is None else [found[name]]
    if panels := [variable.name for variable in chosen if variable.name in panel_variables(model)]:
        raise ModelError(
            f"the panel {panels[0]!r} has no such results: make a model of one record, or give the "
            "var_name of a variable without a panel"
        )
    return chosen if filter is None else [with_other_filter(v, filter) for v in chosen]
