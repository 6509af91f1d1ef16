"""Graphs of small vectors as compiled functions: written out in scalars, or array by array.

A graph has named inputs, each a scalar or a vector of static length, and vector outputs. Two forms
of function are made of it. A *vector function* maps vectors to vectors once, and is called from
functions that numba compiles; a *member function* is an entry point that does it for every column
of an ensemble. Both are written out in scalars where that is possible and small enough, and call
PyTensor's array code otherwise; both forms have the same interface.
"""

import logging
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing import signature
from numba.extending import intrinsic
from numba.np.arrayobj import load_item, make_array
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import io_toposort

from ..native.cache_key import key_of
from .array_fallback import array_member_function, array_vector_function
from .emitter import Emitter, n_operations
from .expressions import Arena, Value
from .function_types import CompiledFunction, Graph, MemberFunction, function_of
from .machine_code import DOUBLE, POINTER, Code, Module, constant
from .members import member_entry_point
from .scalarize import NotUnrollableError, unroll

_LOG = logging.getLogger("pymc_statespace_filters")

# Of one function, written out. An operation takes about 1 ms to compile: the EKF of 20 states with
# a full matrix of parameters has 27000 operations and takes 22 s. Array code takes 40 s for the EKF
# of 12 states and 50 s for 20, and runs seventeen times slower there. CPU seconds of a first call.
MAX_EXPRESSIONS = 30_000
# In a graph of at most so many operations on arrays; in a larger one in proportion, because array
# code takes 10 ms or more to compile for each: of 13000 operations on arrays, 49000 on scalars, it
# was not compiled after 85 s, and was written out in 15 s.
MANY_NODES = 3000
TRIED = 5  # times as many may be tried, at 20 us each: some turn out not to be needed
MAX_OUTPUT_ELEMENTS = 2000  # of a state of the EKF with 60 states: mean and covariance

# Above one of these numbers, of operations and of results, a function is optimised and becomes
# machine code in its callers only: 17 s instead of 28 s for the gradient of 20 states. The code of
# a function that returns 1700 numbers, the constants of 40 states, took 40 s.
LARGE = 1000
LARGE_TUPLE = 400


def unrolled(graph: Graph, *, to_ask: bool = False) -> list[list[Value]]:
    """The elements of every output as scalar expressions, see `unroll`."""
    size = sum(np.prod(output.type.shape or (1,)) for output in graph.outputs)
    if size > MAX_OUTPUT_ELEMENTS:
        raise NotUnrollableError(f"more than {MAX_OUTPUT_ELEMENTS} numbers")
    arena = Arena()
    values = [_input_elements(arena, name, v) for name, v in graph.inputs.items()]
    inputs = list(graph.inputs.values())
    n_nodes = len(io_toposort(inputs, graph.outputs))
    most = int(MAX_EXPRESSIONS * max(1.0, n_nodes / MANY_NODES))
    arrays = unroll(arena, inputs, values, graph.outputs, TRIED * most, to_ask=to_ask)
    lists = [list(np.atleast_1d(a)) for a in arrays]
    if n_operations(v for group in lists for v in group) > most:
        raise NotUnrollableError(f"more than {most} scalar operations")
    return lists


def _input_elements(arena: Arena, name: str, variable: Variable) -> np.ndarray:
    shape = variable.type.shape
    out = np.empty(shape, dtype=object)
    for index in np.ndindex(shape):
        out[index] = arena.input(f"{name}.{index[0] if index else 0}")
    return out


def member_function(
    name: str, arguments: str, graph: Graph, target: str, *, vector: bool = True
) -> MemberFunction:
    """The entry point that writes the first output for every member to ``target``, X or out.

    Python calls its ``function`` with these ``arguments``. Not in ``vector`` code if it is for one
    member.
    """
    try:
        (values,) = unrolled(graph)
    except NotUnrollableError as reason:
        log_choice(name, reason)
        return MemberFunction(array_member_function(name, graph, target), arguments)
    log_choice(name)
    entry = member_entry_point(name, graph, values, target, vector=vector)
    return MemberFunction(entry, arguments)


def vector_function(name: str, arguments: str, graph: Graph) -> CompiledFunction:
    """A function of these arguments that returns vectors, to be read by index.

    In scalars a vector is a tuple of numbers, otherwise an array.
    """
    try:
        values = unrolled(graph)
    except NotUnrollableError as reason:
        log_choice(name, reason)
        return array_vector_function(name, arguments, graph)
    log_choice(name)
    flat = [v for group in values for v in group]
    code, used = vector_code(flat)
    for entry in code.needs:
        entry.compile()  # now: machine code of the caller may come from disk
    places = [_place(graph, element) for element in used]
    sizes = [len(group) for group in values]
    scope = {"evaluate": _inserted(arguments, code, places, sizes)}
    large = n_operations(flat) > LARGE or len(flat) > LARGE_TUPLE
    compiled, source = function_of(name, arguments, [f"return evaluate({arguments})"], scope, large)
    return CompiledFunction(compiled, key_of(__name__, f"{source}{places}{sizes}", code.key), large)


def log_choice(names: str, reason: Exception | None = None) -> None:
    """Log in which form functions are compiled, and why not in scalars."""
    if reason is None:
        _LOG.debug("%s: written out in scalars", names)
    else:
        _LOG.debug("%s: array code, because of %s", names, reason)


def vector_code(values: Sequence[Value]) -> tuple[Code, list[str]]:
    """``main(given, out)`` writes these values, and the names of the inputs that are given."""
    module, used = Module(), list[str]()
    main = module.function("main", [POINTER, POINTER])
    given, out = main.args
    builder = ir.IRBuilder(main.append_basic_block())

    def read(name: str) -> ir.Value:
        used.append(name)
        return builder.load(builder.gep(given, [constant(len(used) - 1)]))

    emitter = Emitter(module, builder, read, vector=False)
    for i, value in enumerate(emitter.floats(values)):
        builder.store(value, builder.gep(out, [constant(i)]))
    builder.ret_void()
    return module.finished(), used


# What inputs are elements of, if not of a vector of their name.
_ARGUMENT = {"theta": ("c",), "u": ("inputs", "k")}


def _place(graph: Graph, element: str) -> tuple:
    """An argument and indices in it, numbers or other arguments."""
    name, _, i = element.partition(".")
    return (*_ARGUMENT.get(name, (name,)), int(i)) if graph.inputs[name].type.ndim else (name,)


def _inserted(
    arguments: str, code: Code, places: Sequence[tuple], sizes: Sequence[int]
) -> Callable:
    """The function of these arguments, in compiled code, that calls ``main``.

    Its results are vectors of these sizes. Its code is inserted into that of its callers.
    """
    kinds = [types.UniTuple(types.float64, n) for n in sizes]
    returned = kinds[0] if len(kinds) == 1 else types.Tuple(kinds)
    names = [argument.strip() for argument in arguments.split(",")]

    def typed(given_kinds: tuple) -> tuple:
        def insert(context: Any, builder: Any, _: Any, values: Sequence) -> Any:
            frame = _Frame(context, builder, names, given_kinds, values)
            given, out = (_room(builder, n) for n in (len(places), sum(sizes)))
            for i, (name, *indices) in enumerate(places):
                builder.store(frame.read(name, *indices), builder.gep(given, [constant(i)]))
            code.call(context, builder, [given, out])
            loaded = (builder.load(builder.gep(out, [constant(i)])) for i in range(sum(sizes)))
            made = [
                context.make_tuple(builder, kind, [next(loaded) for _ in range(n)])
                for n, kind in zip(sizes, kinds, strict=True)
            ]
            return made[0] if len(made) == 1 else context.make_tuple(builder, returned, made)

        return signature(returned, *given_kinds), insert

    scope = {"typed": typed}
    exec(f"def code(typing, {arguments}): return typed(({arguments},))", scope)
    return intrinsic(scope["code"])


def _room(builder: ir.IRBuilder, n: int) -> ir.Value:
    return cgutils.alloca_once(builder, DOUBLE, size=constant(max(n, 1)))


class _Frame:
    """The arguments of an intrinsic where it is inserted, by their names."""

    def __init__(
        self, context: Any, builder: Any, names: Sequence[str], kinds: Sequence, values: Sequence
    ) -> None:
        self._context, self._builder = context, builder
        self._kinds = dict(zip(names, kinds, strict=True))
        self._values = dict(zip(names, values, strict=True))
        self._arrays: dict[str, Any] = {}

    def read(self, name: str, *indices: int | str) -> ir.Value:
        """A number: an argument, or an element of one."""
        context, build, kind = self._context, self._builder, self._kinds[name]
        value = self._values[name]
        if not indices:
            return context.cast(build, value, kind, types.float64)
        if isinstance(kind, types.BaseTuple):
            element = build.extract_value(value, indices[0])
            return context.cast(build, element, kind[indices[0]], types.float64)
        if name not in self._arrays:
            self._arrays[name] = make_array(kind)(context, build, value)
        at = [self._values[i] if isinstance(i, str) else constant(i) for i in indices]
        array = self._arrays[name]
        place = cgutils.get_item_pointer(context, build, kind, array, at, wraparound=False)
        return load_item(context, build, kind, place)
