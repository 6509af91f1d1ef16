"""Types of compiled functions and of the graphs they come from; compilation of their source."""

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numba import types
from pytensor.graph.basic import Variable

from ..native.entry_point import EntryPoint
from ..native.jit import FAST_MATH, linked, njit_generated
from ..native.planned_function import address_of_array
from .arguments import MEMBER_ARGUMENTS, PARAMETER_ARGUMENTS

# Inputs that differ between the members of an ensemble.
MEMBER_INPUTS = frozenset({"x", "z"})


@dataclass(frozen=True)
class CompiledFunction:
    """A compiled function, and the key that identifies its code.

    Without a key the code cannot be cached on disk. A ``large`` one becomes machine code in its
    callers only, and cannot be called from Python.
    """

    function: Any
    key: str | None = None
    large: bool = False


_PLACES = {"Z": "z", "d": "z", "noise": "z", "D": "out", "M": "out", "gains": "out"}


@dataclass(frozen=True)
class MemberFunction:
    """An entry point with `MEMBER_ARGUMENTS`, and the arguments of its ``function``."""

    entry: EntryPoint
    arguments: str

    @property
    def key(self) -> str | None:
        """Identifies the code."""
        return self.entry.key

    @cached_property
    def function(self) -> Callable[..., None]:
        """Call it with arrays from Python, for which nothing more is compiled."""
        call, names = _from_python(self.entry, MEMBER_ARGUMENTS), self.arguments.split(", ")

        def function(*values: Any) -> None:
            given = dict(zip(names, values, strict=True))
            words = dict.fromkeys(MEMBER_ARGUMENTS, 0)
            words |= {_PLACES.get(name, name): value for name, value in given.items()}
            words["width"] = given["Z"].shape[1] if "Z" in given else 0
            words["n_members"] = given["X"].shape[1]
            call(*words.values())

        return function


@dataclass(frozen=True)
class ParameterFunction:
    """An entry point with `PARAMETER_ARGUMENTS` that writes a vector of this length."""

    entry: EntryPoint
    length: int

    @property
    def key(self) -> str | None:
        """Identifies the code."""
        return self.entry.key

    @cached_property
    def function(self) -> Callable[[np.ndarray], np.ndarray]:
        """Call it with an array from Python; an array is returned."""
        call = _from_python(self.entry, PARAMETER_ARGUMENTS)

        def function(theta: np.ndarray) -> np.ndarray:
            out = np.empty(self.length)
            call(theta, theta.size, out)
            return out

        return function


_C_TYPES: dict[Any, Any] = {
    types.float64: ctypes.c_double,
    types.intp: ctypes.c_int64,
}  # others are addresses


def _from_python(entry: EntryPoint, arguments: Mapping[str, Any]) -> Callable[..., None]:
    """The entry point with these arguments, of which those that are addresses may be arrays."""
    entry.compile()
    kinds = [_C_TYPES.get(kind, ctypes.c_void_p) for kind in arguments.values()]
    run = ctypes.CFUNCTYPE(None, *kinds)(entry.address)

    def call(*values: Any) -> None:
        run(*(_checked_address(v) if isinstance(v, np.ndarray) else v for v in values))

    return call


def _checked_address(values: np.ndarray) -> int:
    if values.dtype != np.float64 or not values.flags.c_contiguous:
        raise ValueError("arrays must be contiguous, in C order, of float64")
    return address_of_array(values)


@dataclass(frozen=True)
class Graph:
    """Named inputs (scalars or vectors of static length) and vector outputs."""

    inputs: Mapping[str, Variable]
    outputs: Sequence[Variable]


def function_of(
    name: str,
    arguments: str,
    body: Sequence[str],
    namespace: Mapping[str, Any],
    large: bool = False,
) -> tuple[Any, str]:
    """Compile a function from the lines of its body, which use the names in ``namespace``."""
    source = f"def {name}({arguments}):\n" + "".join(f"    {line}\n" for line in body)
    names = dict(namespace)
    exec(compile(source, f"<{name} of a state-space system>", "exec"), names)
    return jit(names[name], large), source


def jit(function: Any, large: bool = False) -> Any:
    """Compile with the flags of all generated code."""
    # A large function has one caller, into which it is inlined; alone, it would be optimised twice.
    decorator = linked(forceinline=True, fastmath=FAST_MATH) if large else njit_generated
    return decorator(function)
