"""Names of a system: parameters with defaults and shapes, states, observables and inputs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .checks import is_integer
from .drift import DriftingParameter
from .equations import RESERVED, Equation, read_equation

TIME, BEFORE = "time", "before"  # columns of a table of events, see `events`


@dataclass(frozen=True)
class Signature:
    """Parameters in order of appearance, defaults of some, shapes of all, and input names."""

    parameters: tuple[str, ...]
    defaults: tuple[tuple[str, Any], ...]
    shapes: tuple[tuple[int, ...], ...]
    inputs: tuple[str, ...]

    def with_drift(self, drifting: Sequence[DriftingParameter]) -> "Signature":
        """The same with the parameters of drift behind the others."""
        shapes = dict(zip(self.parameters, self.shapes, strict=True))
        own = {
            name: shapes[one.parameter] if one.law_index else ()
            for one in drifting
            for name in one.laws
        }
        return replace(
            self, parameters=(*self.parameters, *own), shapes=(*self.shapes, *own.values())
        )


def read_signature(
    equations: Sequence[Equation],
    shapes: Mapping[str, Sequence[int]] | None,
    inputs: Sequence[str] | None,
) -> Signature:
    """The signature of a system with these functions."""
    names, defaults = parameter_names(equations)
    declared = _shapes(names, shapes)
    _check_defaults(defaults, dict(zip(names, declared, strict=True)))
    input_names = checked_names("inputs", inputs, None)
    with_inputs = [
        equation.role
        for equation in equations
        # The drift of `second_order` has no external force without inputs.
        if "u" in equation.symbols and not hasattr(equation.function, "inputs_are_optional")
    ]
    if with_inputs and not input_names:
        raise ModelError(
            f"{with_inputs[0]} has the argument u, so inputs must name the inputs "
            f'(inputs=["..."]), got {inputs!r}'
        )
    return Signature(names, defaults, declared, input_names)


def parameter_names(equations: Sequence[Equation]) -> tuple[tuple[str, ...], tuple]:
    """Names of the parameters in order of appearance, and their defaults."""
    names: dict[str, None] = {}
    defaults: dict[str, Any] = {}
    for equation in equations:
        names |= dict.fromkeys(equation.parameters)
        for name, value in equation.defaults:
            if defaults.setdefault(name, value) != value:
                raise ModelError(
                    f"parameter {name!r} must have one default, got {defaults[name]} and {value}"
                )
    return tuple(names), tuple(defaults.items())


def _shapes(
    names: tuple[str, ...], shapes: Mapping[str, Sequence[int]] | None
) -> tuple[tuple[int, ...], ...]:
    """The declared shape of every parameter; a parameter is a scalar unless declared."""
    declared = dict(shapes or {})
    unknown = sorted(set(declared) - set(names))
    if unknown:
        raise ModelError(f"shapes must name parameters, {list(names)}, got {unknown}")
    for name, shape in declared.items():
        if not isinstance(shape, Sequence) or not all(is_integer(s) and s > 0 for s in shape):
            raise ModelError(
                f"shapes[{name!r}] must be a tuple of positive integers, got {shape!r}"
            )
    return tuple(tuple(map(int, declared.get(name, ()))) for name in names)


def _check_defaults(
    defaults: Sequence[tuple[str, Any]], shapes: Mapping[str, tuple[int, ...]]
) -> None:
    """Raise unless every default has the declared shape of its parameter."""
    for name, value in defaults:
        if np.shape(value) != shapes[name]:
            raise ModelError(
                f"the default of {name!r} must have the parameter's shape {shapes[name]}, got "
                f"shape {np.shape(value)}; declare it with shapes={{{name!r}: {np.shape(value)}}}"
            )


def size_of(shape: tuple[int, ...]) -> int:
    """Number of elements of a parameter of this shape."""
    return int(np.prod(shape, dtype=int))


def parameter_symbols(
    theta: TensorVariable, names: Sequence[str], shapes: Sequence[tuple[int, ...]]
) -> dict[str, TensorVariable]:
    """The parameters by name, as slices of the flat vector."""
    symbols, start = {}, 0
    for name, shape in zip(names, shapes, strict=True):
        stop = start + size_of(shape)
        part = theta[start] if shape == () else theta[start:stop].reshape(shape)
        symbols[name], start = part, stop
    return symbols


def checked_names(
    role: str, names: Sequence[str] | None, default: list[str] | None
) -> tuple[str, ...]:
    """Distinct names, as many as there are in the default; the default if none are given."""
    if names is None:
        return tuple(default or ())
    if isinstance(names, str) or not all(isinstance(n, str) for n in names):
        raise ModelError(f"{role} must be a list of names, got {names!r}")
    if len(set(names)) != len(names):
        raise ModelError(f"{role} must be distinct names, got {list(names)}")
    if default is not None and len(names) != len(default):
        raise ModelError(f"{role} must name {len(default)} components, got {list(names)}")
    return tuple(names)


def checked_events(event: Any, events: Sequence[str]) -> tuple[str, ...]:
    """The names of the numbers of an event, which are arguments of its function."""
    names = checked_names("events", events, None)
    if event is None:
        if names:
            raise ModelError(
                f"event must be the function that changes the state, with the arguments "
                f"{list(names)}, got None"
            )
        return names
    reserved = {**RESERVED, TIME: "the times of events", BEFORE: "their order"}
    if taken := [name for name in names if name in reserved]:
        raise ModelError(
            f"events must not have the name {taken[0]!r}, which is that of {reserved[taken[0]]}"
        )
    own = read_equation("event", event, ("x", "u", "t", *names)).symbols
    if missing := [name for name in names if name not in own]:
        raise ModelError(f"events must name arguments of event, got {missing[0]!r}, which is none")
    return names


def check_names_of_events(events: Sequence[str], parameters: Sequence[str]) -> None:
    """Raise if the number of an event is an argument of another function."""
    if shared := [name for name in events if name in parameters]:
        raise ModelError(
            f"{shared[0]!r} must be a number of events, which event alone has as an argument, or a "
            "parameter of another function, got both: rename one"
        )


def names_of_states(role: str, names: Sequence[str], states: tuple[str, ...]) -> tuple[str, ...]:
    """Distinct names, which must be those of states."""
    names = checked_names(role, names, None)
    unknown = [name for name in names if name not in states]
    if unknown:
        raise ModelError(f"{role} must name states, {list(states)}, got {unknown}")
    return names
