"""Names: of parameters, with their defaults and shapes, and of states, observables and inputs."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system.equations import Equation


def parameter_names(equations: Sequence[Equation]) -> tuple[tuple[str, ...], tuple]:
    """Names of the parameters in order of appearance, and their defaults."""
    names: dict[str, None] = {}
    defaults: dict[str, Any] = {}
    for equation in equations:
        names |= dict.fromkeys(equation.parameters)
        for name, value in equation.defaults:
            if defaults.setdefault(name, value) != value:
                raise ModelError(
                    f"parameter {name!r} has two defaults, {defaults[name]} and {value}"
                )
    return tuple(names), tuple(defaults.items())


def shapes_of(
    names: tuple[str, ...], shapes: Mapping[str, Sequence[int]] | None
) -> tuple[tuple[int, ...], ...]:
    """The declared shape of every parameter; scalars if nothing is declared."""
    declared = dict(shapes or {})
    unknown = sorted(set(declared) - set(names))
    if unknown:
        raise ModelError(f"shapes names unknown parameters {unknown}; parameters are {list(names)}")
    for name, shape in declared.items():
        whole = isinstance(shape, Sequence) and all(isinstance(s, int) and s > 0 for s in shape)
        if not whole:
            raise ModelError(
                f"shapes[{name!r}] must be a tuple of positive integers, got {shape!r}"
            )
    return tuple(tuple(declared.get(name, ())) for name in names)


def check_defaults(
    defaults: Sequence[tuple[str, Any]], names: Sequence[str], shapes: Sequence[tuple[int, ...]]
) -> None:
    """Raise if a default has another shape than the parameter is declared with."""
    shape_of = dict(zip(names, shapes, strict=True))
    for name, value in defaults:
        if np.shape(value) != shape_of[name]:
            raise ModelError(
                f"the default of {name!r} has shape {np.shape(value)}, but the parameter has "
                f"shape {shape_of[name]}; declare it with shapes={{{name!r}: {np.shape(value)}}}"
            )


def size_of(shape: tuple[int, ...]) -> int:
    """How many numbers a parameter of this shape has."""
    return int(np.prod(shape, dtype=int))


def parameter_symbols(
    theta: TensorVariable, names: Sequence[str], shapes: Sequence[tuple[int, ...]]
) -> dict[str, TensorVariable]:
    """The parameters by name, cut out of the flat vector."""
    symbols, start = {}, 0
    for name, shape in zip(names, shapes, strict=True):
        stop = start + size_of(shape)
        part = theta[start] if shape == () else theta[start:stop].reshape(shape)
        symbols[name], start = part, stop
    return symbols


def checked_names(
    role: str, names: Sequence[str] | None, default: list[str] | None
) -> tuple[str, ...]:
    """Names that differ, as many as the default has; the default if none are given."""
    if names is None:
        return tuple(default or ())
    if isinstance(names, str) or not all(isinstance(n, str) for n in names):
        raise ModelError(f"{role} must be a list of names, got {names!r}")
    if len(set(names)) != len(names):
        raise ModelError(f"{role} must differ from each other, got {list(names)}")
    if default is not None and len(names) != len(default):
        raise ModelError(f"{role} must name {len(default)} components, got {list(names)}")
    return tuple(names)


def carried_names(carried: Sequence[str], states: tuple[str, ...]) -> tuple[str, ...]:
    """The names of carried states, which must be states."""
    names = checked_names("carried", carried, None)
    unknown = [name for name in names if name not in states]
    if unknown:
        raise ModelError(f"carried names unknown states {unknown}; states are {list(states)}")
    return names
