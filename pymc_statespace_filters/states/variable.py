"""A state-space variable at draws of the posterior: its parameters, inputs and records."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.graph.basic import Variable
from pytensor.graph.replace import clone_replace
from pytensor.graph.traversal import ancestors

from ..compiler.native.pytensor_function import NativeFunction
from ..compiler.native.rows import Rows
from ..compiler.numerics.philox import generators_of_records
from ..errors import ModelError
from ..evaluation.health import Health
from ..filters.outcomes import NONE
from ..progress import row_progress
from ..pymc_model.state_space_variable import (
    StateSpaceVariable,
    observed_variables,
    with_other_filter,
)
from ..system.given_record import of_each_record
from ..system.input_columns import only_seen
from ..system.panel_records import ALONE, FIRST_INPUT, RECORD, STEP, records_of
from ..system.record import read_inputs
from ..system.time_axis import TimeAxis
from .draws import SAMPLE_DIMS, PosteriorDraws
from .record import Array, RecordAtDraws


class VariableAtDraws:
    """One variable at draws of its model's posterior, as a sequence of records.

    A variable without a panel is one record. ``on_progress`` is called with the number of
    evaluations, of a draw and a record each, since its last call.
    """

    def __init__(
        self, model: pm.Model, variable: StateSpaceVariable, draws: PosteriorDraws
    ) -> None:
        self.model, self.variable, self.draws = model, variable, draws
        self.on_progress: Callable[[int], None] = lambda count: None
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
        self.records = self._find_records()

    @property
    def n_draws(self) -> int:
        """Number of draws, of all chains."""
        return int(np.prod(self.draws.shape))

    @cached_property
    def stored_seeds(self) -> NDArray[np.int64] | None:
        """The seeds of the estimates of each draw; None where none are stored or read."""
        variable = self.variable
        if not variable.filter.noisy:
            return None
        return self.draws.stored_seeds(variable.name, len(self.records))

    @cached_property
    def theta(self) -> Array:
        """Flat parameters of every record at every draw, (draws, G, k)."""
        theta = self._interpret(self.variable.theta)
        return theta if self.variable.is_panel else theta[:, None]

    @cached_property
    def inputs(self) -> Array:
        """Input rows of all records at every draw, (draws or 1, rows, n_input_columns)."""
        graph = self.variable.inputs
        if set(self._replaced) & set(ancestors([graph])):
            return self._interpret(graph)
        return pytensor.function([], graph, mode="FAST_COMPILE")()[None]

    def with_inputs(self, inputs: Any, axes: Sequence[TimeAxis]) -> "VariableAtDraws":
        """The same with other inputs, for observations on the axis of every record."""
        variable, system = self.variable, self.variable.system
        records, table = ALONE, self.records[0].steps
        if variable.is_panel:
            table = variable.steps.eval(mode="FAST_COMPILE")
            own = [record.label for record in self.records]
            records = records_of(table[:, RECORD])._replace(labels=own)
        parts = of_each_record("inputs", inputs, records.labels)
        rows, firsts = read_inputs(parts, system, records, axes)
        if variable.is_panel:
            table[:, FIRST_INPUT] = 0 if firsts is None else firsts[records.of_rows()]
        observed = np.concatenate([record.observed for record in self.records])
        rows = only_seen(system, rows, table, observed)
        changed = variable._replace(inputs=pt.as_tensor(rows), steps=pt.as_tensor(table))
        return VariableAtDraws(self.model, changed, self.draws)

    def generators(self, rng: np.random.Generator) -> list[np.random.Generator]:
        """A generator for each record, which does not depend on the other records."""
        if not self.variable.is_panel:
            return [rng]
        return generators_of_records(rng, np.array([record.code for record in self.records]))

    @contextmanager
    def progress(self, task: str, *, enabled: bool, n_tasks: int = 1) -> Iterator[None]:
        """Show a bar that counts the evaluations of ``n_tasks`` operations on every record."""
        with row_progress(self, enabled=enabled) as begin:
            begin(task, n_tasks * self.n_draws * len(self.records))
            yield
            begin("", 0)  # fills the bar, if there were fewer

    def warn_about(self, health: Sequence[Array], seeds: Sequence[NDArray[np.int64]]) -> None:
        """Warn of failures and of collapse, given health (draws, 3) and seeds of every record.

        Raises `ModelError` if the filter fails with a noise seed with which the draw's chain had a
        likelihood.
        """
        self._check_seeds(np.any([each[:, 1] != NONE for each in health], axis=0))

        def arguments_of(i: int) -> tuple[Any, ...]:
            number, draw = divmod(i, self.n_draws)
            return self.records[number].arguments(draw, seeds[number][draw])

        labels = [one.label for one in self.records] if self.variable.is_panel else None
        system, filter = self.variable.system, self.variable.filter
        Health(system, filter, np.concatenate(health), arguments_of, labels).tell()

    def _check_seeds(self, failed: NDArray[np.bool_]) -> None:
        """Raise if the stored seeds cannot be those of the draws, given where the filter fails.

        With another filter or other data than in the run it may fail.
        """
        draws, variable = self.draws, self.variable
        if not failed.any() or self.stored_seeds is None or "lp" not in draws.stats:
            return
        name, filter = str(variable.name), repr(variable.filter)
        log_density = draws.stats["lp"].transpose(*SAMPLE_DIMS).values.ravel()
        wrong = failed & np.isfinite(log_density)
        if name in draws.observed:
            now = np.concatenate([record.observed for record in self.records]).ravel()
            if not np.array_equal(draws.observed[name].values.ravel(), now, equal_nan=True):
                return
        if wrong.any() and draws.filters.get(name, filter) == filter:
            raise ModelError(
                f"{name}_seed in sample_stats of idata is of another run or another model: with "
                f"it {filter} fails at {wrong.sum()} of {failed.size} draws, at which their chain "
                "had a finite likelihood; use the sample_stats of these draws, or drop them from "
                "idata for fresh noise"
            )

    def _interpret(self, graph: Variable) -> Array:
        """A graph at every draw."""
        # Microseconds for each draw: machine code would take longer to compile than it saves.
        bound = clone_replace(graph, self._replaced)
        # The index of the draw makes sure that there is at least one input that varies.
        symbols = [pt.lscalar("number"), *self._symbols]
        columns = [np.arange(self.n_draws), *self._columns]
        with pytensor.config.change_flags(mode="FAST_COMPILE"):
            function = pytensor.function(
                symbols, [bound], on_unused_input="ignore", trust_input=True
            )
        first = [column[0] for column in columns]
        (found,) = Rows(NativeFunction(function, first), len(columns))(*columns)
        return found

    def _find_records(self) -> list[RecordAtDraws]:
        """The records, from the current data of the model."""
        variable = self.variable
        symbols = [variable.steps, variable.observed, variable.t0]
        steps, observed, t0 = pytensor.function([], symbols, mode="FAST_COMPILE")()
        observed = np.array(observed, dtype=np.float64)
        if variable.score_from >= len(steps):
            raise ModelError(
                f"score_from of {variable.name!r} must be less than the number of observations, got"
                f" {variable.score_from} of {len(steps)}"
            )
        if not variable.is_panel:
            return [RecordAtDraws(self, 0, None, None, steps, observed, float(t0))]
        records = records_of(steps[:, RECORD])
        labels = self.model.coords.get(f"{variable.name}_record", ())
        if len(labels) != len(records.labels):  # other rows were set
            labels = records.labels
        first_inputs, n_rows = steps[records.starts[:-1], FIRST_INPUT], self.inputs.shape[1]
        # All records share all rows, or have their own, one stretch below the other.
        is_shared = not first_inputs.any()
        ends = [n_rows] * len(labels) if is_shared else [*first_inputs[1:], n_rows]
        return [
            RecordAtDraws(
                self,
                number,
                int(records.codes[number]),
                label,
                steps[rows, STEP].copy(),
                observed[rows],
                float(t0),
                slice(int(first_inputs[number]), int(ends[number])),
            )
            for number, (label, rows) in enumerate(zip(labels, records.slices(), strict=True))
        ]


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
    return chosen if filter is None else [with_other_filter(v, filter) for v in chosen]
