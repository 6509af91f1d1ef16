"""The flat parameter vector of a system, from numbers by name."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system.model import StateSpaceModel


def check_names(system: StateSpaceModel, params: Mapping[str, Any]) -> None:
    """Raise if ``params`` holds a name that the system does not have."""
    if not isinstance(params, Mapping):
        raise ModelError(f"params must be a mapping from names to values, got {params!r}")
    unknown = [name for name in params if name not in system.parameters]
    if unknown:
        raise ModelError(
            f"params names unknown parameters {unknown}; parameters are {list(system.parameters)}"
        )


def missing_parameters(system: StateSpaceModel, found: Mapping[str, Any]) -> ModelError:
    """The error that lists which parameters have no value."""
    missing = [name for name in system.parameters if name not in found]
    return ModelError(
        f"no value for the parameters {missing}: the system needs {list(system.parameters)}, "
        f"found {sorted(found)}"
    )


def flat_parameters(system: StateSpaceModel, params: Mapping[str, Any]) -> np.ndarray:
    """Parameter values as an array of shape S + (k,), S the shape to which they broadcast."""
    check_names(system, params)
    values = dict(system.defaults) | dict(params)
    if any(name not in values for name in system.parameters):
        raise missing_parameters(system, values)
    parts, batches = [], []
    for name, shape in zip(system.parameters, system.parameter_shapes, strict=True):
        part = parameter_numbers(name, values[name])
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
        raise ModelError(f"parameter arrays do not broadcast together: {shapes}") from None
    if not parts:
        return np.zeros((0,))
    return np.concatenate([np.broadcast_to(p, (*batch, p.shape[-1])) for p in parts], axis=-1)


def parameter_numbers(name: str, value: Any) -> np.ndarray:
    """A parameter's value as an array; never NaN."""
    try:
        array = np.asarray(value, dtype="float64")
    except (TypeError, ValueError):
        raise ModelError(f"parameter {name!r} must be numbers, got {value!r}") from None
    if np.isnan(array).any():
        raise ModelError(f"parameter {name!r} must not be NaN, got {value!r}")
    return array
