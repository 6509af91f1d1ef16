"""Graphs of small vectors as compiled functions: written out in scalars, or array by array.

A graph has named inputs, each a scalar or a vector of static length, and vector outputs. Two forms
of function are made of it. A *vector function* maps vectors to vectors once; a *member function*
does it for every column of an ensemble. Both are written out in scalars where that is possible and
small enough, and call PyTensor's array code otherwise; both forms have the same interface.
"""

import logging
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pytensor.scalar as ps
from pytensor.graph.basic import Variable
from pytensor.link.numba.dispatch.basic import numba_funcify

from pymc_statespace_filters.compiler.codegen.array_fallback import (
    array_member_function,
    array_vector_function,
)
from pymc_statespace_filters.compiler.codegen.expressions import Arena, Expression, Value
from pymc_statespace_filters.compiler.codegen.function_types import (
    MEMBER_INPUTS,
    CompiledFunction,
    Graph,
    VectorFunction,
    function_of,
)
from pymc_statespace_filters.compiler.codegen.scalarize import NotUnrollableError, unroll
from pymc_statespace_filters.compiler.codegen.source import (
    VECTOR_NAMESPACE,
    Writer,
    depends_on,
    n_operations,
)
from pymc_statespace_filters.compiler.codegen.stages import BLOCK, Stages, is_block
from pymc_statespace_filters.compiler.codegen.straight_line import straight_line
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.errors import LoweringError

_LOG = logging.getLogger("pymc_statespace_filters")

# Of one function, written out. An operation takes about 1 ms to compile: the EKF of 20 states with
# a full matrix of parameters has 27000 operations and takes 22 s. Array code takes 40 s for the EKF
# of 12 states and 50 s for 20, and runs seventeen times slower there. CPU seconds of a first call.
MAX_EXPRESSIONS = 30_000
TRIED = 5  # times as many may be tried, at 20 us each: some turn out not to be needed
MAX_OUTPUT_ELEMENTS = 2000  # of a state of the EKF with 60 states: mean and covariance

# Above one of these numbers, of statements and of results, a function is optimised and becomes
# machine code in its callers only: 17 s instead of 28 s for the gradient of 20 states. The code of
# a function that returns 1700 numbers, the constants of 40 states, took 40 s.
LARGE = 1000
LARGE_TUPLE = 400

# LLVM vectorises a loop only if it needs at most 128 run-time checks that two rows do not overlap;
# 8 rows that are written and as many that are only read need 92.
MAX_ROWS_COMPARED = 8

# The code that reads element i of an input, if not that of a vector; members are columns.
_ELEMENT = {
    "theta": "c[{i}]", "u": "inputs[k, {i}]", "t": "t", "x": "X[{i}, member]",
    "z": "Z[{i}, member]", "term_bar": "term_bar", "tape": "tape[row, {i}]",
}  # fmt: skip


def unrolled(graph: Graph) -> list[list[Value]]:
    """The elements of every output as scalar expressions."""
    size = sum(np.prod(output.type.shape or (1,)) for output in graph.outputs)
    if size > MAX_OUTPUT_ELEMENTS:
        raise NotUnrollableError(f"more than {MAX_OUTPUT_ELEMENTS} numbers")
    arena = Arena()
    values = [_input_elements(arena, name, v) for name, v in graph.inputs.items()]
    most = TRIED * MAX_EXPRESSIONS
    arrays = unroll(arena, list(graph.inputs.values()), values, graph.outputs, most)
    lists = [list(np.atleast_1d(a)) for a in arrays]
    if n_operations(v for group in lists for v in group) > MAX_EXPRESSIONS:
        raise NotUnrollableError(f"more than {MAX_EXPRESSIONS} scalar operations")
    return lists


def _input_elements(arena: Arena, name: str, variable: Variable) -> np.ndarray:
    shape = variable.type.shape
    out = np.empty(shape, dtype=object)
    for index in np.ndindex(shape):
        out[index] = arena.input(f"{name}.{index[0] if index else 0}")
    return out


def _element_code(graph: Graph) -> dict[str, str]:
    return {
        f"{name}.{i}": _ELEMENT.get(name, name + "[{i}]").format(i=i)
        for name, variable in graph.inputs.items()
        for i in range(variable.type.shape[0] if variable.type.ndim else 1)
    }


def vector_functions(functions: Mapping[str, VectorFunction]) -> dict[str, CompiledFunction]:
    """Functions that pass vectors to each other: all written out in scalars, or all on arrays.

    In scalars a vector is a tuple of numbers, otherwise an array; both are read by index.
    """
    try:
        written = {name: unrolled(f.graph) for name, f in functions.items()}
    except NotUnrollableError as reason:
        _log_choice(", ".join(functions), reason)
        return {name: array_vector_function(name, f) for name, f in functions.items()}
    _log_choice(", ".join(functions))
    return {name: _scalar_vector_function(name, f, written[name]) for name, f in functions.items()}


def _log_choice(names: str, reason: Exception | None = None) -> None:
    if reason is None:
        _LOG.debug("%s: written out in scalars", names)
    else:
        _LOG.debug("%s: array code, because of %s", names, reason)


def _scalar_vector_function(name: str, function: VectorFunction, values: list) -> CompiledFunction:
    writer = Writer(_element_code(function.graph))
    lines = writer.statements(v for group in values for v in group)
    results = [
        writer.as_float(group[0])
        if is_scalar
        else "(" + "".join(f"{writer.as_float(v)}, " for v in group) + ")"
        for group, is_scalar in zip(values, function.scalar, strict=True)
    ]
    lines.append(f"return {', '.join(results)}")
    arguments, n_results = function.arguments, sum(map(len, values))
    return build(
        name,
        arguments,
        [f"return all({arguments})"],
        writer,
        n_results > LARGE_TUPLE,
        all=(arguments, lines),
    )


def member_function(name: str, arguments: str, graph: Graph, target: str) -> CompiledFunction:
    """``name(arguments)`` writes the first output of every member to ``target``.

    What does not depend on the member is computed once, before the loop.
    """
    try:
        (values,) = unrolled(graph)
    except NotUnrollableError as reason:
        _log_choice(name, reason)
        return array_member_function(name, arguments, graph, target)
    _log_choice(name)
    writer = Writer(_element_code(graph), VECTOR_NAMESPACE)
    members = frozenset(key for key in _element_code(graph) if key[0] in MEMBER_INPUTS)
    dependent = depends_on(values, members)
    common = [a for e in dependent for a in e.args if e.op is not None and a not in dependent]
    kept = sorted_by_number({*common, *(v for v in values if v not in dependent)})
    before = writer.statements(kept)
    if any(map(is_block, dependent)):
        return _in_stages(name, arguments, writer, (before, kept), values, dependent, target)
    inside, results = writer.statements(values), [writer.as_float(v) for v in values]
    names = [writer.name(v) for v in kept]
    inside = [*(f"{name} = common[{i}]" for i, name in enumerate(names)), *inside]
    before.append(f"return ({''.join(f'{name}, ' for name in names)})")
    loop = _loop if len(values) <= MAX_ROWS_COMPARED else _staged_loop
    body, inputs, inside = loop(f"{arguments}, member, common", inside, results, target)
    return build(
        name,
        arguments,
        [f"common = before({arguments})", *body],
        writer,
        before=(arguments, before),
        inside=(inputs, inside),
    )


def _in_stages(
    name: str,
    arguments: str,
    writer: Writer,
    before: tuple[list[str], list],
    values: list[Value],
    dependent: set[Expression],
    target: str,
) -> CompiledFunction:
    """A member function with functions that have branches, see `stages`."""
    lines, kept = before
    names = "".join(f"{writer.name(v)}, " for v in kept)
    lines.append(f"return ({names})")
    stages = Stages(writer, values, dependent, kept)
    inputs = f"{arguments}, member, common, buffer, j"
    given = f"{arguments}, np.uint64(first + j), common, buffer, np.uint64(j)"
    body = [f"common = before({arguments})", *stages.body(given, target)]
    blocks = {f"stage_{i}": (inputs, inside) for i, inside in enumerate(stages.inside)}
    return build(name, arguments, body, writer, before=(arguments, lines), **blocks)


def _loop(
    inputs: str, inside: list[str], results: list[str], target: str
) -> tuple[list[str], str, list[str]]:
    """A loop over all members; the arguments and lines of the code ``inside`` that it calls."""
    stores = [f"{target.format(i=i)} = {result}" for i, result in enumerate(results)]
    head = f"for member in range({target.partition('[')[0]}.shape[-1]):"
    return [head, f"    inside({inputs})"], inputs, [*inside, *stores]


def _staged_loop(
    inputs: str, inside: list[str], results: list[str], target: str
) -> tuple[list[str], str, list[str]]:
    """The same loop over blocks of members, whose results are buffered and then copied.

    The buffer does not overlap any row that is read, so LLVM needs no check for each pair of rows.
    """
    whole, inputs = target.partition("[")[0], f"{inputs}, buffer, j"
    stores = [f"buffer[{i}, j] = {result}" for i, result in enumerate(results)]
    block = [
        f"size = min({BLOCK}, {whole}.shape[-1] - first)",
        "for j in range(size):",
        # A signed index might be negative and count from the end, which prevents vectorisation.
        "    member = np.uint64(first + j)",
        f"    inside({inputs})",
        f"for i in range({len(results)}):",
        "    for j in range(size):",
        f"        {whole}[i, np.uint64(first + j)] = buffer[i, j]",
    ]
    body = [
        f"buffer = np.empty(({len(results)}, {BLOCK}))",
        f"for first in range(0, {whole}.shape[-1], {BLOCK}):",
        *(f"    {line}" for line in block),
    ]
    return body, inputs, [*inside, *stores]


def copy_elements(arguments: str, target: str, source: str, size: int) -> Any:
    """``copy(arguments)`` sets ``target``, a place for element i, to the elements of a vector.

    A tuple that is indexed in a loop compiles to a branch for each of its elements.
    """
    return straight_line(
        arguments, [f"{target.format(i=i)} = {source}[{i}]" for i in range(size)], {}
    )


def all_finite(size: int) -> Any:
    """``all_finite(vector)``: whether the first elements are finite, without a loop as above."""
    tests = [f"abs(s[{i}]) < inf" for i in range(size)]
    return straight_line("s", [f"return {' and '.join(tests)}"], {"inf": np.inf})


def sorted_by_number(values: Iterable[Value]) -> list[Value]:
    """Expressions in order of creation, so that the source is canonical."""
    return sorted((v for v in values if hasattr(v, "number")), key=lambda v: v.number)


def build(
    name: str,
    arguments: str,
    body: Sequence[str],
    writer: Writer,
    large: bool = False,
    /,
    **blocks: tuple[str, Sequence[str]],
) -> CompiledFunction:
    """Compile a function body that calls blocks of a writer's statements.

    A block is given by its arguments and lines.
    """
    namespace, key = blocks_of(writer, **blocks)
    large |= sum(len(lines) for _, lines in blocks.values()) > LARGE
    function, source = function_of(name, arguments, body, namespace, large)
    return CompiledFunction(function, key_of(__name__, source, key), large)


def blocks_of(
    writer: Writer, **blocks: tuple[str, Sequence[str]]
) -> tuple[dict[str, Any], str | None]:
    """Blocks of a writer's statements, and what they call, as functions; and their key."""
    others = {called: _scalar_function(*op) for called, op in writer.fallbacks.items()}
    namespace = {**writer.namespace, **others}
    code = {block: straight_line(*given, namespace) for block, given in blocks.items()}
    texts = [f"{block}({given}):\n" + "\n".join(lines) for block, (given, lines) in blocks.items()]
    operations = [repr(op) for op, _ in writer.fallbacks.values()]
    return {**namespace, **code}, key_of(__name__, *texts, *operations)


def _scalar_function(op: ps.ScalarOp, n_arguments: int) -> Any:
    node = op.make_node(*(ps.float64() for _ in range(n_arguments)))
    try:
        return numba_funcify(op, node=node)
    except NotImplementedError as error:
        raise LoweringError(
            f"functions of the system must consist of pytensor.tensor operations that numba "
            f"supports, got {op}"
        ) from error
