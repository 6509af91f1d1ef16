"""Types of compiled functions and of the graphs they come from; compilation of their source."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from pytensor.graph.basic import Variable

from ..native.entry_point import EntryPoint, address_of, call_address
from ..native.jit import FAST_MATH, linked, njit_generated
from .arguments import MEMBER_ARGUMENTS

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
    def function(self) -> Any:
        """Call it with arrays, from Python or from compiled functions."""
        values = dict.fromkeys(MEMBER_ARGUMENTS, "np.int64(0)") | {"t": "0.0"}
        for name in (names := self.arguments.split(", ")):
            values[_PLACES.get(name, name)] = f"{name} * 1.0" if name == "t" else name
        values |= {"k": "np.int64(k)"} if "k" in names else {}
        values |= {"width": "np.int64(Z.shape[1])"} if "Z" in names else {}
        values["n_members"] = "np.int64(X.shape[1])"
        return _jitted(self.entry, self.arguments, values)


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
    def function(self) -> Any:
        """Call it with an array, from Python or from compiled functions; an array is returned."""
        values = {"theta": "theta", "n_theta": "np.int64(theta.size)", "out": "out"}
        before, after = f"out = np.empty({self.length})", "return out"
        return _jitted(self.entry, "theta", values, before, after)


def _jitted(entry: EntryPoint, arguments: str, values: Mapping[str, str], *around: str) -> Any:
    """The function of these arguments that calls an entry point with these values."""
    entry.compile()
    arrays = [name for name in arguments.split(", ") if name not in ("k", "t")]
    before, after = around or ("", "")
    lines = [
        *(f"if not {name}.flags.c_contiguous: raise ValueError(message)" for name in arrays),
        before, f"call_address(address_of(symbol), ({', '.join(values.values())}))", after,
    ]  # fmt: skip
    scope = {
        "np": np, "address_of": address_of, "call_address": call_address, "symbol": entry.symbol,
        "message": "arrays must be contiguous, in C order",
    }  # fmt: skip
    exec(f"def function({arguments}):\n" + "".join(f"    {line}\n" for line in lines), scope)
    return jit(scope["function"])


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
