"""The flat parameter vector of a system, from values by name: numbers or symbols; or of a panel."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.basic import Constant, Variable
from pytensor.raise_op import CheckAndRaise
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .equations import RESERVED
from .labels import element_label, rows_in_order
from .model import StateSpaceModel
from .panel_records import Records
from .record import Record

_OTHER_NUMBER = (
    "parameter {name!r} must have a value for each record; when pm.set_data changes the number of "
    "records, change the parameter's dimension too"
)


def check_names(system: StateSpaceModel, params: Mapping[str, Any]) -> None:
    """Raise unless ``params`` is a mapping from names of the system's parameters."""
    if not isinstance(params, Mapping):
        raise ModelError(f"params must be a mapping from names to values, got {params!r}")
    unknown = [name for name in params if name not in system.parameters]
    if unknown:
        reserved = [f"; {name!r} is {what}" for name, what in RESERVED.items() if name in unknown]
        raise ModelError(
            f"params must name parameters of the system, {list(system.parameters)}, got "
            f"{unknown}{''.join(reserved)}"
        )


def flat_parameters(system: StateSpaceModel, params: Mapping[str, Any]) -> np.ndarray:
    """Parameter values as an array of shape S + (k,), S the shape to which they broadcast."""
    check_names(system, params)
    values = dict(system.defaults) | dict(params)
    check_complete(system, values)
    parts, batches = [], []
    for name, shape in zip(system.parameters, system.parameter_shapes, strict=True):
        part = numbers(name, values[name])
        core = part.ndim - len(shape)
        if core < 0 or part.shape[core:] != shape:
            raise ModelError(
                f"parameter {name!r} must have shape (..., *{shape}), got {part.shape}"
            )
        batches.append(part.shape[:core])
        parts.append(part.reshape(*part.shape[:core], int(np.prod(shape, dtype=int))))
    try:
        batch = np.broadcast_shapes(*batches)
    except ValueError:
        shapes = dict(zip(system.parameters, batches, strict=True))
        raise ModelError(f"params must be arrays that broadcast together, got {shapes}") from None
    if not parts:
        return np.zeros((0,))
    return np.concatenate([np.broadcast_to(p, (*batch, p.shape[-1])) for p in parts], axis=-1)


def known_elements(
    system: StateSpaceModel, values: Mapping[str, Any]
) -> tuple[tuple[int, float], ...]:
    """The elements of the flat parameters that are numbers, the same in all records, and these."""
    known: list[tuple[int, float]] = []
    first = 0
    for name, shape in zip(system.parameters, system.parameter_shapes, strict=True):
        value: Any = values.get(name, ...)
        value = value.data if isinstance(value, Constant) else value
        if value is not ... and not isinstance(value, Variable) and np.shape(value) == shape:
            known += enumerate(numbers(name, value).ravel().tolist(), first)
        first += int(np.prod(shape, dtype=int))
    return tuple(known)


def element_names(system: StateSpaceModel) -> list[str]:
    """Names of the elements of flat parameters (k,), such as "k[0]"."""
    return [
        element_label(name, index)
        for name, shape in zip(system.parameters, system.parameter_shapes, strict=True)
        for index in np.ndindex(shape)
    ]


def symbolic_parameters(
    system: StateSpaceModel, values: Mapping[str, Any], others: Sequence[str]
) -> TensorVariable:
    """Parameter values, numbers or symbols, as a symbolic vector (k,).

    ``others`` are the names among which a missing one may be, misspelt.
    """
    names = f"the model's variables are {sorted(others)}: name one so, or give the value in params"
    check_complete(system, values, names)
    check_starts(system, values)
    parts = [
        _symbol(name, values[name], shape).ravel()
        for name, shape in zip(system.parameters, system.parameter_shapes, strict=True)
    ]
    theta = pt.concatenate(parts) if parts else pt.as_tensor(np.zeros(0))
    return pt.specify_shape(theta, (system.n_theta,))


def _symbol(name: str, value: Any, shape: tuple[int, ...]) -> TensorVariable:
    symbol: Any = value if isinstance(value, Variable) else pt.as_tensor(numbers(name, value))
    has_shape = symbol.type.ndim == len(shape) and all(
        s is None or s == e for s, e in zip(symbol.type.shape, shape, strict=False)
    )
    if not has_shape:
        found = str(symbol.type.shape).replace("None", "?")
        ways = (
            f": give one element, params={{{name!r}: ...}}, declare shapes={{{name!r}: ...}} in "
            "the system for an array, or name the records in panel= where each has its own"
        )
        raise ModelError(
            f"parameter {name!r} must have shape {shape}, got {found}{'' if shape else ways}"
        )
    return pt.cast(symbol, "float64")


def check_complete(system: StateSpaceModel, found: Mapping[str, Any], others: str = "") -> None:
    """Raise unless every parameter has a value."""
    if missing := [name for name in system.parameters if name not in found]:
        optional = [name for name, _ in system.defaults]
        needed = [name for name in system.parameters if name not in optional]
        also = f" (optional, with a default: {optional})" if optional else ""
        given = f"only for {sorted(name for name in found if name not in optional)}"
        raise ModelError(
            f"params must give every parameter without a default, {needed}{also}, got "
            f"no value for the parameters {missing}; {others or given}"
        )


def check_starts(system: StateSpaceModel, values: Mapping[str, Any]) -> None:
    """Raise if a number that is given for a drifting parameter lies outside its scale."""
    for one in system.drifting:
        if isinstance(values[one.parameter], Variable):
            continue
        start = numbers(one.parameter, values[one.parameter])
        place: tuple[Any, ...] = (..., *one.index)
        if not one.link.contains(start[place]):
            raise ModelError(
                f"parameter {one.parameter!r} must start on the scale {one.process.scale!r} of its "
                f"drift, got {start.tolist()!r}"
            )


def numbers(name: str, value: Any) -> np.ndarray:
    """The value of a parameter as an array, which may hold infinities but no NaN."""
    if np.ma.is_masked(value):
        raise ModelError(f"parameter {name!r} must have no masked values, got {value!r}")
    try:
        array = np.asarray(value, dtype="float64")
    except (TypeError, ValueError):
        raise ModelError(f"parameter {name!r} must be numbers, got {value!r}") from None
    if np.isnan(array).any():
        raise ModelError(f"parameter {name!r} must not be NaN, got {value!r}")
    return array


def panel_parameters(
    system: StateSpaceModel, params: Mapping[str, Any], records: Records
) -> np.ndarray:
    """Parameter values (G, k): each shared, or, of a panel, with a leading dimension of records."""
    if not records.is_panel:
        theta = flat_parameters(system, params)
        if theta.ndim != 1:
            raise ModelError(
                f"params must have one value per parameter, got arrays of {theta.shape[:-1]}"
            )
        return theta[None]
    check_names(system, params)
    values = dict(system.defaults) | dict(params)
    check_complete(system, values)
    n_records, parts = len(records.labels), [np.zeros((len(records.labels), 0))]
    for name, shape in zip(system.parameters, system.parameter_shapes, strict=True):
        part = numbers(name, _by_record(name, values[name], shape, records))
        _check_shape(name, shape, part.shape, n_records)
        whole = np.broadcast_to(part, (n_records, *shape))
        parts.append(whole.reshape(n_records, -1))
    return np.concatenate(parts, axis=1)


def symbolic_panel_parameters(
    system: StateSpaceModel,
    values: Mapping[str, Any],
    panel: Record,
    others: Sequence[str],
) -> TensorVariable:
    """Parameter values, numbers or symbols, as a symbolic matrix (G, k)."""
    names = f"the model's variables are {sorted(others)}: name one so, or give the value in params"
    check_complete(system, values, names)
    check_starts(system, values)
    n_records = len(panel.records.labels)
    parts: list[Any] = [np.zeros((n_records, 0))] if not system.parameters else []
    for name, shape in zip(system.parameters, system.parameter_shapes, strict=True):
        value = _by_record(name, values[name], shape, panel.records)
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


def _by_record(name: str, value: Any, shape: tuple[int, ...], records: Records) -> Any:
    """A value with a row for each record, if it has rows, in the order of the records."""
    if isinstance(value, Variable) or np.ndim(value) == len(shape):
        return value
    return rows_in_order(f"parameter {name!r}", value, records.labels)


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
