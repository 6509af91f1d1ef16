"""Compiled functions: what they are made of, how they are compiled, and under which key."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numba
from pytensor.graph.basic import Variable

# NaN and infinity keep their meaning: failures are found by them. With reassociation allowed beside
# "nsz", x - x becomes 0 for every x, and numba's isfinite, which is made of it, is always true.
FAST_MATH = {"contract", "nsz", "arcp"}

# Inputs of which every member of an ensemble has its own.
MEMBER_INPUTS = frozenset({"x", "z"})


@dataclass(frozen=True)
class Compiled:
    """A compiled function and the key that identifies its code (None: not cacheable)."""

    function: Any
    key: str | None


@dataclass(frozen=True)
class Graph:
    """Named inputs (scalars or vectors of static length) and vector outputs."""

    inputs: Mapping[str, Variable]
    outputs: Sequence[Variable]


@dataclass(frozen=True)
class VectorFunction:
    """What a vector function is made of; ``scalar[i]`` tells that output i is one number."""

    arguments: str
    graph: Graph
    scalar: Sequence[bool] = (False,)


def function_of(
    name: str, arguments: str, body: Sequence[str], namespace: Mapping[str, Any]
) -> tuple[Any, str]:
    """Compile a function from the lines of its body, which may name what is in ``namespace``."""
    source = f"def {name}({arguments}):\n" + "".join(f"    {line}\n" for line in body)
    names = dict(namespace)
    exec(compile(source, f"<{name} of a state-space system>", "exec"), names)
    return jit(names[name]), source


def jit(function: Any) -> Any:
    """Compile as all code of this room is compiled."""
    return numba.njit(function, nogil=True, error_model="numpy", fastmath=FAST_MATH)


def digest(*parts: str) -> str:
    """The key of compiled code that is made of ``parts`` by the code of this package."""
    return hashlib.sha256("\0".join((_source_digest(), *parts)).encode()).hexdigest()


def key_of(what: str, *keys: str | None) -> str | None:
    """The key of code made of ``what`` and compiled parts; None if a part cannot be cached."""
    known = [key for key in keys if key is not None]
    return digest(what, *known) if len(known) == len(keys) else None


@cache
def _source_digest() -> str:
    """Machine code on disk must not outlive the code that it was made by."""
    package = Path(__file__).parent.parent
    # All that machine code can be made by; samplers and evidence make none that is cached here.
    files = sorted(
        f for folder in (".", "lowering", "filters", "ops") for f in package.glob(folder + "/*.py")
    )
    return hashlib.sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()
