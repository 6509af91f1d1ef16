"""Types of compiled functions and of the graphs they come from; compilation of their source."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numba
from pytensor.graph.basic import Variable

from pymc_statespace_filters.compiler.native.cache_key import FAST_MATH
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
