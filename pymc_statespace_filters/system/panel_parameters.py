"""The parameters of a panel: values that all records share, or one for each record."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.basic import Variable
from pytensor.raise_op import CheckAndRaise
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .model import StateSpaceModel
from .panel import SymbolicPanel
from .panel_records import Records
from .parameters import check_complete, check_names, numbers

_OTHER_NUMBER = (
    "parameter {name!r} must have a value for each record; when pm.set_data changes the number of "
    "records, change the parameter's dimension too"
)


def panel_parameters(
    system: StateSpaceModel, params: Mapping[str, Any], records: Records
) -> np.ndarray:
    """Parameter values (G, k): each shared, or with a leading dimension of records."""
    check_names(system, params)
    values = dict(system.defaults) | dict(params)
    check_complete(system, values)
    n_records, parts = len(records.labels), [np.zeros((len(records.labels), 0))]
    for name, shape in zip(system.parameters, system.parameter_shapes, strict=True):
        part = numbers(name, values[name])
        _check_shape(name, shape, part.shape, n_records)
        whole = np.broadcast_to(part, (n_records, *shape))
        parts.append(whole.reshape(n_records, -1))
    return np.concatenate(parts, axis=1)


def symbolic_panel_parameters(
    system: StateSpaceModel,
    values: Mapping[str, Any],
    panel: SymbolicPanel,
    others: Sequence[str],
) -> TensorVariable:
    """Parameter values, numbers or symbols, as a symbolic matrix (G, k)."""
    names = f"the model's variables are {sorted(others)}: name one so, or give the value in params"
    check_complete(system, values, names)
    n_records = len(panel.records.labels)
    parts: list[Any] = [np.zeros((n_records, 0))] if not system.parameters else []
    for name, shape in zip(system.parameters, system.parameter_shapes, strict=True):
        value = values[name]
        symbol = pt.as_tensor(value if isinstance(value, Variable) else numbers(name, value))
        _check_shape(name, shape, symbol.type.shape, n_records)
        size = int(np.prod(shape, dtype=int))
        if symbol.type.ndim == len(shape):
            part = pt.broadcast_to(symbol.reshape((1, size)), (panel.n_records, size))
        else:
            part = symbol.reshape((symbol.shape[0], size))
            if isinstance(panel.n_records, Variable):
                fits = pt.eq(symbol.shape[0], panel.n_records)
                part = CheckAndRaise(ModelError, _OTHER_NUMBER.format(name=name))(part, fits)
        parts.append(pt.cast(part, "float64"))
    return pt.specify_shape(pt.concatenate(parts, axis=1), (None, system.n_theta))


def _check_shape(name: str, shape: tuple[int, ...], found: tuple, n_records: int) -> None:
    """Raise unless the shape is that of a shared parameter or one of each record."""
    own = (n_records, *shape)
    expected = shape if len(found) == len(shape) else own
    if len(found) != len(expected) or any(
        n is not None and n != m for n, m in zip(found, expected, strict=True)
    ):
        raise ModelError(
            f"parameter {name!r} must have shape {shape} (one value for all records) or {own} (one "
            f"for each of the {n_records} records), got {tuple(found)}"
        )
