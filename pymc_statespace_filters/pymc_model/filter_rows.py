"""A filter at many points of a model, whose state is kept: one more row costs one update.

Rows are evaluated at all points by machine code, in threads where that is worth it. A state is what
`evaluation.run_filter` stores. A run that goes on has the bits of one run over all rows; points
side by side may differ from a point alone in the last bit.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..compiler.lowering.compiled_system import compile_system
from ..filters.protocol import DifferentiableFilter, Filter, properties
from ..filters.state_law import StateLaw
from ..ops.at_points import FilterAtPoints
from ..ops.base import FilterOp
from ..ops.states import FilterRun, GoingOn
from ..system.model import StateSpaceModel

Array = NDArray[np.float64]


class Record(NamedTuple):
    """Steps (J,), data (J, p) and inputs of a record, and the time of step 0."""

    steps: NDArray[np.int64]
    observed: Array
    inputs: Array
    t0: np.ndarray

    def rows(self, begin: int, end: int) -> "Record":
        """Some rows, with the inputs of all."""
        return self._replace(steps=self.steps[begin:end], observed=self.observed[begin:end])

    def first(self, n_rows: int) -> "Record":
        """The record that ends with the last of some rows."""
        return self.rows(0, n_rows)._replace(inputs=self.inputs[: self.steps[n_rows - 1]])


class FilterRows:
    """The filter of one system along rows of a record, for many parameters and seeds at once."""

    def __init__(self, system: StateSpaceModel, filter: Filter) -> None:
        self.filter, self._system = filter, system
        self._together = properties(filter).resumes_many
        operation: FilterOp = FilterRun(system, filter)
        if self._together:
            assert isinstance(filter, DifferentiableFilter)
            operation = GoingOn(system, filter)
        self._at_points = FilterAtPoints(operation, ["terms", "state"])

    def __call__(
        self,
        theta: Array,
        seeds: NDArray[np.int64],
        states: Array,
        record: Record,
    ) -> tuple[Array, Array]:
        """Terms (m, J) of the rows of a record, and the states behind them.

        ``states`` (m, S) are those before the rows; of no columns where the rows are the first. A
        filter that looks ahead sees one row at a time: with all of them at once, its estimates
        would be of another distribution than those of a run that goes on row by row.
        """
        looks_ahead = properties(self.filter).needs_record_ahead
        evaluate = self._row_by_row if looks_ahead else self._evaluate
        terms, after = evaluate(theta, seeds, states, record)
        if np.isnan(after[:, -1]).all():  # states need not have the length that there is room for
            after = after[:, ~np.isnan(after).all(axis=0)]
        return terms, after

    def _row_by_row(
        self, theta: Array, seeds: NDArray[np.int64], states: Array, record: Record
    ) -> tuple[Array, Array]:
        terms, alive = np.full((len(theta), len(record.steps)), -np.inf), np.arange(len(theta))
        for row in range(len(record.steps)):
            found, left = self._evaluate(
                theta[alive], seeds[alive], states, record.rows(row, row + 1)
            )
            known = np.isfinite(found[:, 0])
            terms[alive, row] = found[:, 0]
            alive, states = alive[known], left[known]
            if not alive.size:
                break
        after = np.full((len(theta), states.shape[1]), np.nan)
        after[alive] = states
        return terms, after

    def law_of_state(self, states: Array) -> StateLaw:
        """The law of the system's state at the points, from what the filter has left."""
        return self.filter.law_of_state(compile_system(self._system), states)

    def _evaluate(
        self, theta: Array, seeds: NDArray[np.int64], states: Array, record: Record
    ) -> tuple[Array, Array]:
        varying: dict[str, np.ndarray] = {"theta": theta}
        constant = record._asdict()
        if not self._together:  # each point has its own noise, and a state has no first dimension
            varying["seed"] = seeds
            constant["wanted"] = np.empty(0, np.int64)
        if self._together or states.shape[1]:
            varying["state"] = states
        else:
            constant["state"] = np.empty(0)
        terms, after = self._at_points(varying, constant)
        return terms, after
