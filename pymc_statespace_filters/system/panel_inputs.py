"""The inputs of a panel: rows that all records share, or stretches of their own."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .checks import shortened
from .model import StateSpaceModel
from .panel_records import Records
from .record import check_inputs, inputs_of_other_shape


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
        isinstance(part, np.ndarray | Variable) and part.ndim for part in inputs
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
