"""Graphs of small vectors as compiled functions: written out in scalars, or array by array.

A graph has named inputs, each a scalar or a vector of static length, and vector outputs. Two forms
of function are made of it. A *vector function* maps vectors to vectors once; a *member function*
does it for every column of an ensemble. Both are written out in scalars where that is possible and
small enough, and call PyTensor's own array code otherwise; a caller cannot tell the difference.
"""

import hashlib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytensor
import pytensor.scalar as ps
from pytensor.compile.mode import get_mode
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.fg import FunctionGraph
from pytensor.graph.traversal import io_toposort
from pytensor.link.numba.dispatch.basic import numba_funcify, numba_funcify_and_cache_key

from pymc_statespace_filters.errors import LoweringError
from pymc_statespace_filters.lowering.loops import use_loops
from pymc_statespace_filters.lowering.scalars import Arena, Value
from pymc_statespace_filters.lowering.source import Writer, depends_on
from pymc_statespace_filters.lowering.unroll import NotUnrollableError, unroll

# Beyond this many scalar operations machine code takes longer to make than it saves.
MAX_EXPRESSIONS = 1500
MAX_OUTPUT_ELEMENTS = 200

# NaN and infinity keep their meaning: failures are found by them. With reassociation allowed beside
# "nsz", x - x becomes 0 for every x, and numba's isfinite, which is made of it, is always true.
FAST_MATH = {"contract", "nsz", "arcp"}

# How generated code reads element i of an input; members are columns.
_ELEMENT = {
    "theta": "c[{i}]", "u": "inputs[k, {i}]", "t": "t", "d": "d[{i}]", "x": "X[{i}, member]",
    "z": "Z[{i}, member]", "s": "s[{i}]", "s_bar": "s_bar[{i}]", "c_bar": "c_bar[{i}]",
    "term_bar": "term_bar",
}  # fmt: skip
# How array code reads a whole input.
_WHOLE = {
    "theta": "c", "u": "inputs[k]", "t": "np.asarray(t)", "d": "d", "x": "X[:, member].copy()",
    "z": "Z[:{n}, member].copy()", "s": "s", "s_bar": "s_bar", "c_bar": "c_bar",
    "term_bar": "np.asarray(term_bar)",
}  # fmt: skip
_MEMBER_INPUTS = frozenset({"x", "z"})


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

    def unrolled(self) -> list[list[Value]]:
        """The elements of every output as scalar expressions."""
        size = sum(np.prod(output.type.shape or (1,)) for output in self.outputs)
        if size > MAX_OUTPUT_ELEMENTS:
            raise NotUnrollableError(f"more than {MAX_OUTPUT_ELEMENTS} numbers")
        arena = Arena()
        values = [_input_elements(arena, name, v) for name, v in self.inputs.items()]
        arrays = unroll(arena, list(self.inputs.values()), values, self.outputs, MAX_EXPRESSIONS)
        return [list(np.atleast_1d(a)) for a in arrays]


def _input_elements(arena: Arena, name: str, variable: Variable) -> np.ndarray:
    shape = variable.type.shape
    out = np.empty(shape, dtype=object)
    for index in np.ndindex(shape):
        out[index] = arena.input(f"{name}.{index[0] if index else 0}")
    return out


def _element_code(graph: Graph) -> dict[str, str]:
    return {
        f"{name}.{i}": _ELEMENT[name].format(i=i)
        for name, variable in graph.inputs.items()
        for i in range(variable.type.shape[0] if variable.type.ndim else 1)
    }


@dataclass(frozen=True)
class VectorFunction:
    """What a vector function is made of; ``scalar[i]`` tells that output i is one number."""

    arguments: str
    graph: Graph
    scalar: Sequence[bool] = (False,)


def vector_functions(functions: Mapping[str, VectorFunction]) -> dict[str, Compiled]:
    """Functions that hand vectors to each other: all of them in scalars, or all on arrays.

    In scalars a vector is a tuple of numbers, otherwise an array; both are read by index.
    """
    try:
        written = {name: f.graph.unrolled() for name, f in functions.items()}
    except NotUnrollableError:
        return {name: _array_vector_function(name, f) for name, f in functions.items()}
    return {name: _scalar_vector_function(name, f, written[name]) for name, f in functions.items()}


def _scalar_vector_function(name: str, function: VectorFunction, values: list) -> Compiled:
    writer = Writer(_element_code(function.graph))
    lines = writer.statements(v for group in values for v in group)
    results = [
        writer.as_float(group[0]) if is_scalar else _tuple([writer.as_float(v) for v in group])
        for group, is_scalar in zip(values, function.scalar, strict=True)
    ]
    body = [*lines, f"return {', '.join(results)}"]
    return _build(name, function.arguments, body, writer.fallbacks)


def member_function(name: str, arguments: str, graph: Graph, target: str) -> Compiled:
    """``name(arguments)`` writes the first output of every member to ``target``.

    What does not depend on the member is computed once, before the loop.
    """
    try:
        (values,) = graph.unrolled()
    except NotUnrollableError:
        return _array_member_function(name, arguments, graph, target)
    writer = Writer(_element_code(graph))
    members = frozenset(key for key in _element_code(graph) if key[0] in _MEMBER_INPUTS)
    dependent = depends_on(values, members)
    shared = [a for e in dependent for a in e.args if e.op is not None and a not in dependent]
    before = writer.statements(
        [*sorted_by_number(shared), *(v for v in values if v not in dependent)]
    )
    inside = writer.statements(values)
    inside += [f"{target.format(i=i)} = {writer.as_float(v)}" for i, v in enumerate(values)]
    loop = [f"for member in range({arguments.split(', ')[-1]}.shape[-1]):"]
    return _build(
        name, arguments, [*before, *loop, *("    " + s for s in inside)], writer.fallbacks
    )


def sorted_by_number(values: Sequence[Value]) -> list[Value]:
    """Expressions in the order of their making, so that the source is canonical."""
    return sorted((v for v in values if hasattr(v, "number")), key=lambda v: v.number)


def _tuple(names: Sequence[str]) -> str:
    return "(" + "".join(f"{name}, " for name in names) + ")"


_GLOBALS = {
    "np": np, "inf": np.inf, "nan": np.nan,
    **{f: getattr(np, f) for f in ("exp", "log", "log1p", "expm1", "sqrt", "sin", "cos", "tan",
       "arctan", "arcsin", "arccos", "tanh", "sinh", "cosh", "floor", "ceil", "exp2", "log2",
       "log10")},
}  # fmt: skip


def _build(
    name: str, arguments: str, body: list[str], fallbacks: dict[str, ps.ScalarOp]
) -> Compiled:
    source = f"def {name}({arguments}):\n" + "".join(f"    {line}\n" for line in body)
    namespace = dict(_GLOBALS)
    for called, op in fallbacks.items():
        namespace[called] = _scalar_function(op, int(called.rsplit("_", 1)[1]))
    exec(compile(source, f"<{name} of a state-space system>", "exec"), namespace)
    return Compiled(jit(namespace[name]), digest(source, *map(repr, fallbacks.values())))


def _scalar_function(op: ps.ScalarOp, n_arguments: int) -> Any:
    node = op.make_node(*(ps.float64() for _ in range(n_arguments)))
    try:
        return numba_funcify(op, node=node)
    except NotImplementedError as error:
        raise LoweringError(
            f"The operation {op} has no compiled form. Write the function without it, "
            f"in terms of pytensor.tensor operations that numba supports."
        ) from error


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
        f for folder in (".", "lowering", "filters") for f in package.glob(folder + "/*.py")
    )
    return hashlib.sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()


# Array code, for graphs that are too large or hold an operation without a scalar form.


def _array_vector_function(name: str, function: VectorFunction) -> Compiled:
    graph = function.graph
    used = _used(graph.inputs, graph.outputs)
    compiled = array_code(list(used.values()), graph.outputs)
    results = [
        f"out[{i}].item()" if scalar else f"out[{i}].copy()"
        for i, scalar in enumerate(function.scalar)
    ]
    nothing = [
        "nan" if scalar else f"np.full({output.type.shape[0]}, nan)"
        for scalar, output in zip(function.scalar, graph.outputs, strict=True)
    ]
    body = [
        "try:",
        f"    out = array_code({_whole(used)})",
        f"    return {', '.join(results)}",
        "except Exception:",  # a singular matrix, say
        f"    return {', '.join(nothing)}",
    ]
    return _build_on_arrays(name, function.arguments, body, array_code=compiled)


def _array_member_function(name: str, arguments: str, graph: Graph, target: str) -> Compiled:
    members = [v for n, v in graph.inputs.items() if n in _MEMBER_INPUTS]
    common = {n: v for n, v in graph.inputs.items() if n not in _MEMBER_INPUTS}
    shared = _frontier(list(graph.inputs.values()), members, graph.outputs)
    used_common = _used(common, shared)
    used_members = _used(
        {n: v for n, v in graph.inputs.items() if n in _MEMBER_INPUTS}, graph.outputs
    )
    before = array_code(list(used_common.values()), shared)
    inside = array_code([*used_members.values(), *shared], graph.outputs)
    whole, _, element = target.partition("[")
    row = "i, " if "{i}" in element else ""
    members = [_whole(used_members)] if used_members else []
    calls = ", ".join([*members, *(f"shared[{i}]" for i in range(len(shared)))])
    body = [
        "try:",
        f"    shared = before({_whole(used_common)})",
        "except Exception:",  # a singular matrix, say
        f"    {whole}[:] = nan",
        "    return",
        f"for member in range({whole}.shape[-1]):",
        "    try:",
        f"        result = inside({calls})[0]",
        "    except Exception:",
        f"        {whole}[..., member] = nan",
        "    else:",
        "        for i in range(result.size):",
        f"            {whole}[{row}member] = result[i]",
    ]
    return _build_on_arrays(name, arguments, body, before=before, inside=inside)


def _build_on_arrays(name: str, arguments: str, body: list[str], **parts: Compiled) -> Compiled:
    source = f"def {name}({arguments}):\n" + "".join(f"    {line}\n" for line in body)
    namespace = _GLOBALS | {part: compiled.function for part, compiled in parts.items()}
    exec(compile(source, f"<{name} of a state-space system>", "exec"), namespace)
    return Compiled(jit(namespace[name]), key_of(source, *(part.key for part in parts.values())))


def _whole(inputs: Mapping[str, Variable]) -> str:
    sizes = {n: (v.type.shape[0] if v.type.ndim else 1) for n, v in inputs.items()}
    return ", ".join(_WHOLE[name].format(n=n) for name, n in sizes.items())


def _used(inputs: Mapping[str, Variable], outputs: Sequence[Variable]) -> dict[str, Variable]:
    found = {i for node in io_toposort(list(inputs.values()), outputs) for i in node.inputs}
    found |= set(outputs)
    return {name: variable for name, variable in inputs.items() if variable in found}


def _frontier(
    inputs: list[Variable], members: list[Variable], outputs: Sequence[Variable]
) -> list[Variable]:
    """Variables that no member enters and that something a member enters reads."""
    dependent, frontier = set(members), []
    nodes = io_toposort(inputs, outputs)
    for node in nodes:
        if any(i in dependent for i in node.inputs):
            dependent.update(node.outputs)
    for node in nodes:
        if any(o in dependent for o in node.outputs):
            frontier += [
                i for i in node.inputs if i not in dependent and not isinstance(i, Constant)
            ]
    frontier += [o for o in outputs if o not in dependent]
    return list(dict.fromkeys(frontier))


def array_code(inputs: list, outputs: Sequence[Variable]) -> Compiled:
    """A graph as PyTensor itself compiles it: arrays in, a tuple of arrays out."""
    # PyMC's checks of parameters become minus infinity: nothing may raise inside a filter.
    mode = get_mode("NUMBA").including("local_check_parameter_to_ninf_switch")
    with warnings.catch_warnings():
        # Python code called back from machine code: slow, not cacheable, and it holds the lock.
        warnings.filterwarnings("error", "Numba will use object mode", UserWarning)
        try:
            function = pytensor.function(
                inputs, list(outputs), mode=mode, on_unused_input="ignore", trust_input=True
            )
            graph: FunctionGraph = function.maker.fgraph
            use_loops(graph)
            code, key = numba_funcify_and_cache_key(graph)
        except (NotImplementedError, UserWarning) as error:
            raise LoweringError(
                f"A function of the system holds an operation without a compiled form ({error}) "
                f"Write the function without it, in terms of pytensor.tensor operations that "
                f"numba supports."
            ) from error
    return Compiled(code, None if key is None else digest(str(key)))
