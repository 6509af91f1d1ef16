"""Panels: several records of one system in one table, as one evaluation takes them.

The rows of a panel are a table of integers (J, 3), one for each observation: a code of the record
that it belongs to, its step, and the row of the inputs that holds during step 0 of that record.
Records that share their inputs all begin at row 0; others have stretches of their own, one below
the other. Every record starts at step 0 and time t0.

The code of a record is its label, or a hash of it if that is a text. The noise of a record depends
on the seed and this code alone, so that it does not change when other records are added.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytensor.tensor as pt
import xarray as xr
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .checks import check_finite, shortened
from .model import StateSpaceModel
from .panel_records import FIRST_INPUT, STEP, Records, records_of
from .record import check_inputs, check_observed, inputs_of_other_shape
from .steps import check_steps, steps_of


def _own_inputs(inputs: Any, records: Records) -> list[Any] | None:
    """The inputs of each record, if they have their own: a mapping or a sequence of arrays."""
    if isinstance(inputs, Mapping):
        if list(inputs) != records.labels and set(inputs) != set(records.labels):
            missing = [label for label in records.labels if label not in inputs]
            raise ModelError(
                f"inputs must have an array for each record, got none for {shortened(missing)}"
                if missing
                else f"inputs must have an array for each record, got others: {shortened(inputs)}"
            )
        return [inputs[label] for label in records.labels]
    is_list = isinstance(inputs, list | tuple) and all(
        isinstance(part, np.ndarray | Variable | pd.DataFrame | xr.DataArray) and part.ndim
        for part in inputs
    )
    if not is_list and not (isinstance(inputs, np.ndarray) and inputs.ndim == 3):
        return None
    if len(inputs) != len(records.labels):
        raise ModelError(
            f"inputs must have an array for each of the {len(records.labels)} records, or one for "
            f"all, got {len(inputs)}"
        )
    return list(inputs)


def panel_inputs(
    inputs: Any, system: StateSpaceModel, records: Records, steps: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray | None]:
    """All rows of inputs, and the first row of each record; None if all share them.

    ``steps`` are the steps of the observations of each record.
    """
    own = _own_inputs(inputs, records)
    if own is None:
        # The observations of one record do not reset the accumulators of another.
        if not system.accumulators:
            records.check_each(lambda rows: check_inputs(inputs, system, rows), steps)
            longest = np.array([max(rows[-1] for rows in steps)])
            return check_inputs(inputs, system, longest), None
        own = [inputs] * len(records.labels)
    parts = records.check_each(lambda part, rows: check_inputs(part, system, rows), own, steps)
    return np.concatenate(parts), _first_rows([len(part) for part in parts])


def _first_rows(lengths: Sequence[int]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype("int64")


def symbolic_panel_inputs(
    inputs: Any, system: StateSpaceModel, records: Records, steps: Sequence[np.ndarray]
) -> tuple[Any, Any]:
    """The same for symbols, of which what is known is checked."""
    own = _own_inputs(inputs, records)
    parts = [inputs] if own is None else own
    if not any(isinstance(part, Variable) for part in parts):
        return panel_inputs(inputs, system, records, steps)
    if system.accumulators:
        raise ModelError(
            "inputs must be numbers for a system with accumulators in a panel, got a symbol"
        )
    current = [
        part.get_value() if isinstance(part, SharedVariable) else part
        for part in parts
        if isinstance(part, SharedVariable) or not isinstance(part, Variable)
    ]
    if len(current) == len(parts):
        panel_inputs(current[0] if own is None else current, system, records, steps)
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
    """A panel of numbers: its records, rows (J, 3), data (J, p), inputs and t0 ()."""

    records: Records
    rows: np.ndarray
    observed: np.ndarray
    inputs: np.ndarray
    t0: np.ndarray

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


class SymbolicPanel(NamedTuple):
    """A panel of numbers or symbols, with the current numbers of its records and steps."""

    records: Records
    current_steps: np.ndarray
    n_records: Any
    rows: Any
    observed: Any
    inputs: Any
    t0: float


def row_coords(
    dim: str,
    labels: Sequence[Any],
    steps: Sequence[np.ndarray],
    prefix: str = "",
    *,
    t0: float,
    dt: float,
) -> dict[str, tuple[str, np.ndarray]]:
    """Coordinates of the rows of a result: record, step and time, given the steps by record."""
    at = np.concatenate(steps)
    return {
        f"{prefix}record": (dim, np.repeat(np.array(labels), [len(one) for one in steps])),
        f"{prefix}step": (dim, at),
        f"{prefix}time": (dim, t0 + at * dt),
    }


def checked_panel(
    system: StateSpaceModel,
    panel: Any,
    observed: Any,
    *,
    steps: Any,
    times: Any,
    inputs: Any,
    t0: Any,
) -> CheckedPanel:
    """Check every part of a panel of numbers."""
    t0 = check_finite("t0", t0)
    records = records_of(panel)
    at = _steps(records, steps, times, system.dt, t0)
    data = _check_observed(observed, system, records)
    forces, first_inputs = panel_inputs(inputs, system, records, records.split(at))
    number = records.of_rows()
    begin = np.zeros_like(at) if first_inputs is None else first_inputs[number]
    rows = np.stack([records.codes[number], at, begin], axis=1)
    return CheckedPanel(records, rows, data, forces, np.asarray(t0))


def symbolic_panel(
    system: StateSpaceModel,
    panel: Any,
    observed: Any,
    *,
    steps: Any,
    times: Any,
    inputs: Any,
    t0: Any,
) -> SymbolicPanel:
    """Check every part of a panel as far as it is known: numbers and the values of shared data."""
    t0 = check_finite("t0", t0)
    if isinstance(times, Variable):
        raise ModelError("times must be numbers, got a symbol; give steps=pm.Data(...) instead")
    records = records_of(_current(panel))
    at = _steps(records, _current(steps), times, system.dt, t0)
    data = None if observed is None else _symbolic_observed(observed, system, records)
    is_symbolic = isinstance(panel, Variable) or isinstance(steps, Variable)
    if is_symbolic and system.accumulators:
        raise ModelError(
            "panel and steps must be numbers for a system with accumulators, which are reset at the"
            " steps of each record, got pm.Data"
        )
    forces, first_inputs = symbolic_panel_inputs(inputs, system, records, records.split(at))
    if isinstance(panel, Variable):
        codes: Any = pt.cast(panel, "int64")
        begins = pt.neq(codes[1:], codes[:-1])
        n_records: Any = 1 + begins.sum()
        number: Any = pt.concatenate([[0], pt.cumsum(begins)])
    else:
        n_records, number = len(records.labels), records.of_rows()
        codes = records.codes[number]
    begin = codes * 0 if first_inputs is None else pt.as_tensor(first_inputs)[number]
    columns = [codes, steps if isinstance(steps, Variable) else at, begin]
    rows: Any = pt.stack([pt.cast(pt.as_tensor(column), "int64") for column in columns], axis=1)
    if not any(isinstance(part, Variable) for part in (panel, steps, first_inputs)):
        rows = rows.eval(mode="FAST_COMPILE")
    return SymbolicPanel(records, at, n_records, rows, data, forces, t0)


def _current(value: Any) -> Any:
    return value.eval() if isinstance(value, Variable) else value


def _steps(records: Records, steps: Any, times: Any, dt: float, t0: float) -> np.ndarray:
    """Steps of all rows; those of a record increase strictly."""
    if (steps is None) == (times is None):
        raise ModelError("give exactly one of steps and times")
    name, values = ("steps", steps) if times is None else ("times", times)
    array = np.asarray(values)
    n_rows = records.starts[-1]
    if array.shape != (n_rows,):
        raise ModelError(
            f"{name} must have shape ({n_rows},), one for each row of panel, got shape "
            f"{array.shape}"
        )
    check = check_steps if times is None else lambda own: steps_of(None, own, dt, t0)
    parts = records.check_each(check, records.split(array))
    return np.concatenate(parts)


def _check_observed(observed: Any, system: StateSpaceModel, records: Records) -> np.ndarray:
    return check_observed(observed, system, int(records.starts[-1]))


def _symbolic_observed(observed: Any, system: StateSpaceModel, records: Records) -> Variable:
    if not isinstance(observed, Variable):
        # A symbol, because PyMC would mask and impute the NaN of an array.
        return pt.as_tensor(_check_observed(observed, system, records))
    if observed.type.ndim != 2:
        raise ModelError(
            f"observed must have 2 dimensions (rows, observables) if it is symbolic, got "
            f"{observed.type.ndim}"
        )
    if isinstance(observed, SharedVariable):
        _check_observed(observed.get_value(), system, records)
    return observed
