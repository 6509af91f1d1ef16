"""Panels: several records of one system in one table, as one evaluation takes them.

The rows of a panel are a table of integers (J, 3), one for each observation: a code of the record
that it belongs to, its step, and the row of the inputs that holds during step 0 of that record.
Records that share their inputs all begin at row 0; others have stretches of their own, one below
the other. Every record starts at step 0 and time t0; at dates, at its own first date.

The code of a record is its label, or a hash of it if that is a text. The noise of a record depends
on the seed and this code alone, so that it does not change when other records are added.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pytensor.tensor as pt
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .clock import Clock
from .given_record import GivenRecord, own_inputs
from .input_columns import only_seen
from .model import StateSpaceModel
from .panel_records import FIRST_INPUT, STEP, Records, records_of
from .placement import Earlier
from .record import check_inputs, checked_data, inputs_of_other_shape, symbolic_data
from .time_axis import TimeAxis
from .timed_inputs import TimedInputs


def panel_inputs(
    inputs: Any, system: StateSpaceModel, records: Records, axes: Sequence[TimeAxis]
) -> tuple[np.ndarray, np.ndarray | None]:
    """All rows of inputs, and the first row of each record; None if all share them."""
    own = own_inputs(inputs, records.labels)
    if own is None:
        # Lengths of steps, and observations that reset accumulators, are those of one record.
        if system.n_input_columns == system.n_inputs:
            records.check_each(lambda axis: check_inputs(inputs, system, axis), axes)
            longest = max(axes, key=lambda axis: axis.steps[-1])
            return check_inputs(inputs, system, longest), None
        own = [inputs] * len(records.labels)
    parts = records.check_each(lambda part, axis: check_inputs(part, system, axis), own, axes)
    return np.concatenate(parts), _first_rows([len(part) for part in parts])


def _first_rows(lengths: Sequence[int]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype("int64")


def symbolic_panel_inputs(
    inputs: Any, system: StateSpaceModel, records: Records, axes: Sequence[TimeAxis]
) -> tuple[Any, Any]:
    """The same for symbols, of which what is known is checked."""
    own = own_inputs(inputs, records.labels)
    parts = [inputs] if own is None else own
    if not any(isinstance(part, Variable) for part in parts):
        return panel_inputs(inputs, system, records, axes)
    if system.n_input_columns > system.n_inputs:
        raise ModelError(
            "inputs must be numbers in a panel of a system with accumulators, with parameters that "
            "are held for several steps, or at times off the grid, got a symbol"
        )
    current = [
        part.get_value() if isinstance(part, SharedVariable) else part
        for part in parts
        if isinstance(part, SharedVariable) or not isinstance(part, Variable)
    ]
    if len(current) == len(parts):
        panel_inputs(current[0] if own is None else current, system, records, axes)
    columns = [_two_dimensional(part, system) for part in parts]
    if own is None:
        return columns[0], None
    lengths = pt.stack([column.shape[0] for column in columns])
    return pt.concatenate(columns), pt.concatenate([[0], pt.cumsum(lengths)[:-1]])


def _two_dimensional(inputs: Any, system: StateSpaceModel) -> TensorVariable:
    symbol = pt.as_tensor(inputs)
    if symbol.type.ndim == 1 and system.n_inputs == 1:
        symbol = symbol[:, None]
    if not system.n_inputs or symbol.type.ndim != 2:
        raise inputs_of_other_shape(system, symbol.type)
    return symbol


class CheckedPanel(NamedTuple):
    """A panel of numbers: its records on their axes, rows (J, 3), data (J, p) and inputs.

    ``system`` is the one that takes the steps of these axes.
    """

    system: StateSpaceModel
    clock: Clock
    records: Records
    axes: list[TimeAxis]
    rows: np.ndarray
    observed: np.ndarray
    inputs: np.ndarray

    @property
    def t0(self) -> np.ndarray:
        """The model time of step 0 of every record."""
        return np.asarray(self.axes[0].t0)

    def single_records(self) -> list[tuple[np.ndarray, ...]]:
        """Steps, observed, inputs and t0 of every record, as a single one has them."""
        return [
            (
                self.rows[own, STEP].copy(),
                self.observed[own],
                self.inputs[self.rows[own.start, FIRST_INPUT] :],
                self.t0,
            )
            for own in self.records.slices()
        ]

    def coords(
        self, dim: str, steps: Sequence[np.ndarray], prefix: str = ""
    ) -> dict[str, tuple[str, np.ndarray]]:
        """Coordinates of the rows of a result: record, step and time, given the steps by record."""
        labels, at = np.array(self.records.labels), np.concatenate(steps)
        return {
            f"{prefix}record": (dim, np.repeat(labels, [len(one) for one in steps])),
            f"{prefix}step": (dim, at),
            f"{prefix}time": (dim, times_of_records(self.clock, self.axes, steps)),
        }


class SymbolicPanel(NamedTuple):
    """A panel of numbers or symbols, with the current numbers of its records on their axes."""

    system: StateSpaceModel
    clock: Clock
    axes: list[TimeAxis]
    records: Records
    n_records: Any
    rows: Any
    observed: Any
    inputs: Any
    timed: tuple[TimedInputs, ...]

    @property
    def t0(self) -> float:
        """The model time of step 0 of every record."""
        return self.axes[0].t0

    def times(self) -> np.ndarray:
        """The user's time of every row."""
        return times_of_records(self.clock, self.axes, [axis.steps for axis in self.axes])


def times_of_records(
    clock: Clock, axes: Sequence[TimeAxis], steps: Sequence[np.ndarray]
) -> np.ndarray:
    """The user's times of the given steps of each record, one after the other."""
    pairs = enumerate(zip(axes, steps, strict=True))
    return np.concatenate([clock.shown(axis.times(own), g) for g, (axis, own) in pairs])


def checked_panel(
    system: StateSpaceModel, given: GivenRecord, earlier: Earlier | None = None
) -> CheckedPanel:
    """Check every part of a panel of numbers; ``observed`` is None for a simulation."""
    records = records_of(given.panel)
    placed = given.placed(system, records, earlier)
    data = checked_data(given.observed, system, int(records.starts[-1]))
    rows_of_user = placed.inputs if placed.timed else given.inputs
    forces, first_inputs = panel_inputs(rows_of_user, placed.system, records, placed.axes)
    number, at = records.of_rows(), np.concatenate([axis.steps for axis in placed.axes])
    begin = np.zeros_like(at) if first_inputs is None else first_inputs[number]
    rows = np.stack([records.codes[number], at, begin], axis=1)
    if given.observed is not None:
        forces = only_seen(system, forces, rows, data)
    return CheckedPanel(placed.system, placed.clock, records, placed.axes, rows, data, forces)


def symbolic_panel(system: StateSpaceModel, given: GivenRecord) -> SymbolicPanel:
    """Check every part of a panel as far as it is known: numbers and the values of shared data."""
    panel, steps, current = given.panel, given.steps, given.current()
    records = records_of(current.panel)
    placed = current.placed(system, records)
    data = symbolic_data(given.observed, system, int(records.starts[-1]))
    system, axes = placed.system, placed.axes
    is_symbolic = isinstance(panel, Variable) or isinstance(steps, Variable)
    if is_symbolic and system.n_input_columns > system.n_inputs:
        raise ModelError(
            "panel and steps must be numbers for a system with accumulators, which are reset at the"
            " steps of each record, with parameters that are held for several steps, and at times "
            "off the grid, got pm.Data"
        )
    rows_of_user = placed.inputs if placed.timed else given.inputs
    forces, first_inputs = symbolic_panel_inputs(rows_of_user, system, records, axes)
    if isinstance(panel, Variable):
        codes: Any = pt.cast(panel, "int64")
        begins = pt.neq(codes[1:], codes[:-1])
        n_records: Any = 1 + begins.sum()
        number: Any = pt.concatenate([[0], pt.cumsum(begins)])
    else:
        n_records, number = len(records.labels), records.of_rows()
        codes = records.codes[number]
    begin = codes * 0 if first_inputs is None else pt.as_tensor(first_inputs)[number]
    at = np.concatenate([axis.steps for axis in axes])
    columns = [codes, steps if isinstance(steps, Variable) else at, begin]
    rows: Any = pt.stack([pt.cast(pt.as_tensor(column), "int64") for column in columns], axis=1)
    if not any(isinstance(part, Variable) for part in (panel, steps, first_inputs)):
        rows = rows.eval(mode="FAST_COMPILE")
    forces = only_seen(system, forces, rows, data)
    return SymbolicPanel(
        system, placed.clock, axes, records, n_records, rows, data, forces, placed.timed
    )
