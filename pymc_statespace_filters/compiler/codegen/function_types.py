"""Types of compiled functions and of the graphs they come from; compilation of their source."""

from collections.abc import Iterable, Mapping, Sequence
from ctypes import CFUNCTYPE, c_double, c_int64, c_void_p
from dataclasses import dataclass
from functools import partial
from typing import Any

import numba
import numpy as np
from numba import types
from pytensor.graph.basic import Variable

from pymc_statespace_filters.compiler.native.cache_key import FAST_MATH
from pymc_statespace_filters.compiler.native.entry_point import F64_PTR, EntryPoint, arguments_class
from pymc_statespace_filters.compiler.native.jit import linked

# Inputs that differ between the members of an ensemble.
MEMBER_INPUTS = frozenset({"x", "z"})


@dataclass(frozen=True)
class CompiledFunction[F]:
    """A compiled function of the type F, and the key that identifies its code.

    Without a key the code cannot be cached on disk. A ``large`` one becomes machine code in its
    callers only, and cannot be called from Python.
    """

    function: F
    key: str | None = None
    large: bool = False


MEMBER_ARGUMENTS = {
    "c": F64_PTR, "inputs": F64_PTR, "k": types.intp, "t": types.float64, "z": F64_PTR,
    "width": types.intp, "X": F64_PTR, "out": F64_PTR, "n_members": types.intp,
}  # fmt: skip
"""Arguments of a function of all members. ``z`` holds normals in rows of ``width``, or one
vector for all members: an observation or noise. ``out`` may hold gains, which are read."""

MemberArguments = arguments_class("MemberArguments", MEMBER_ARGUMENTS, __name__)

PARAMETER_ARGUMENTS = {"theta": F64_PTR, "n_theta": types.intp, "out": F64_PTR}
"""Arguments of a function of parameters."""

_PLACES = {"Z": "z", "d": "z", "noise": "z", "D": "out", "M": "out", "gains": "out"}
_C_TYPES = {F64_PTR: c_void_p, types.intp: c_int64, types.float64: c_double}


@dataclass(frozen=True)
class MemberFunction:
    """An entry point with `MEMBER_ARGUMENTS`, and the arguments with which Python calls it."""

    entry: EntryPoint
    arguments: str

    @property
    def key(self) -> str | None:
        """Identifies the code."""
        return self.entry.key

    def function(self, *given: Any) -> None:
        """Call it with arrays."""
        values: dict[str, Any] = dict.fromkeys(MEMBER_ARGUMENTS, 0)
        for name, value in zip(self.arguments.split(", "), given, strict=True):
            values[_PLACES.get(name, name)] = value
            if name in ("X", "Z"):
                values["n_members" if name == "X" else "width"] = value.shape[1]
        _call(self.entry, MEMBER_ARGUMENTS, values.values())


@dataclass(frozen=True)
class ParameterFunction:
    """An entry point with `PARAMETER_ARGUMENTS` that writes a vector of this length."""

    entry: EntryPoint
    length: int

    @property
    def key(self) -> str | None:
        """Identifies the code."""
        return self.entry.key

    def function(self, theta: np.ndarray) -> np.ndarray:
        """Call it with an array."""
        out = np.empty(self.length)
        _call(self.entry, PARAMETER_ARGUMENTS, (theta, theta.size, out))
        return out


def _call(entry: EntryPoint, arguments: Mapping[str, Any], values: Iterable[Any]) -> None:
    """Call an entry point with numbers and arrays."""
    entry.compile()
    call = CFUNCTYPE(None, *(_C_TYPES[kind] for kind in arguments.values()))(entry.address)
    call(*(v.ctypes.data if isinstance(v, np.ndarray) else v for v in values))


@dataclass(frozen=True)
class Graph:
    """Named inputs (scalars or vectors of static length) and vector outputs."""

    inputs: Mapping[str, Variable]
    outputs: Sequence[Variable]


@dataclass(frozen=True)
class VectorFunction:
    """The graph and arguments of a vector function; ``scalar[i]`` if output i is one number."""

    arguments: str
    graph: Graph
    scalar: Sequence[bool] = (False,)


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
    decorator = (
        partial(linked, forceinline=True)
        if large
        else partial(numba.njit, nogil=True, error_model="numpy")
    )
    return decorator(fastmath=FAST_MATH)(function)
