"""Functions of vectors with operations that have entry points, evaluated in stages.

An operation such as the exact step of a linear equation is machine code compiled once for all
systems. What it takes is computed by generated code, and so is what is made of its results. One
array holds all of these: the inputs, then arguments and result of each operation, then the output.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytensor.tensor as pt
from numba import carray, types
from pytensor.graph.basic import Apply
from pytensor.graph.replace import graph_replace
from pytensor.graph.traversal import io_toposort
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.codegen.function_types import (
    CompiledFunction,
    Graph,
    VectorFunction,
    jit,
)
from pymc_statespace_filters.compiler.codegen.functions import copy_elements, vector_functions
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.compiler.native.entry_point import F64_PTR, EntryPoint
from pymc_statespace_filters.system.linear_step import LinearStep, LinearStepBack, make_functions

_STEP = make_functions(jit)


def _forward(given: Any, out: Any, n: Any) -> None:
    size = 2 * n * n + n
    _STEP.forward(carray(given, (size,)), n, carray(out, (size,)))


def _backward(given: Any, out: Any, n: Any) -> None:
    size = 2 * n * n + n
    both = carray(given, (2 * size,))
    _STEP.backward(both[:size], both[size:], n, carray(out, (size,)))


_ARGUMENTS = {"given": F64_PTR, "out": F64_PTR, "n": types.intp}
ENTRY_POINTS = {
    LinearStep: EntryPoint(_forward, _ARGUMENTS, "linear_step"),
    LinearStepBack: EntryPoint(_backward, _ARGUMENTS, "linear_step_back"),
}
"""The entry point of each operation: it reads its arguments and writes its result."""


def staged(inputs: Sequence[TensorVariable], output: TensorVariable) -> CompiledFunction:
    """The function of the inputs (vectors), in one array, that returns the output, an array."""
    places, size = {}, 0
    for variable in inputs:
        places[variable] = slice(size, size + variable.type.shape[0])
        size += variable.type.shape[0]
    nodes = [n for n in io_toposort(inputs, [output]) if type(n.op) in ENTRY_POINTS]
    starts = []
    for node in nodes:
        starts.append(size)
        size += sum(v.type.shape[0] for v in node.inputs)
        places[node.outputs[0]] = slice(size, size + node.outputs[0].type.shape[0])
        size += node.outputs[0].type.shape[0]
    given, first, length = sum(v.type.shape[0] for v in inputs), size, output.type.shape[0]
    stages = [_nothing()]
    for node, start in zip(nodes, starts, strict=True):
        values = pt.concatenate(node.inputs)
        stages.append(_written(stages[-1], values, start, places, first))
        stages.append(_called(stages[-1], node, start))
    last = _written(stages[-1], output, first, places, first)
    fill, whole = last.function, first + length

    def evaluate(values):
        work = np.empty(whole)
        work[:given] = values
        fill(work)
        return work[first:].copy()

    return CompiledFunction(
        jit(evaluate), key_of(__name__, f"staged {given} {first} {length}", last.key)
    )


def _nothing() -> CompiledFunction:
    return CompiledFunction(jit(lambda work: None), key_of(__name__, "nothing"))


def _written(
    before: CompiledFunction,
    values: TensorVariable,
    start: int,
    places: dict[TensorVariable, slice],
    size: int,
) -> CompiledFunction:
    """The stages before, then these values written to their place."""
    work = pt.tensor("theta", shape=(size,), dtype="float64")
    known = {variable: work[place] for variable, place in places.items()}
    (at_work,) = graph_replace([values], known, strict=False)
    at_work = pt.specify_shape(at_work, values.type.shape)
    function = VectorFunction("c", Graph({"theta": work}, [at_work]))
    compiled = vector_functions({"values": function})["values"]
    length = values.type.shape[0]
    copy = copy_elements("found, work", f"work[{start} + {{i}}]", "found", length)
    earlier, evaluate = before.function, compiled.function

    def stage(work):
        earlier(work)
        copy(evaluate(work[:size]), work)  # array code takes the whole of its argument

    return CompiledFunction(
        jit(stage), key_of(__name__, f"written {start} {length} {size}", before.key, compiled.key)
    )


def _called(before: CompiledFunction, node: Apply, start: int) -> CompiledFunction:
    """The stages before, then an operation on what they wrote."""
    entry_point, n = ENTRY_POINTS[type(node.op)], node.op.n
    entry_point.compile()
    call: Callable = entry_point.external
    result = start + sum(v.type.shape[0] for v in node.inputs)
    earlier = before.function

    def stage(work):
        earlier(work)
        call(work[start:].ctypes.data, work[result:].ctypes.data, n)

    return CompiledFunction(
        jit(stage), key_of(__name__, f"called {start} {n}", before.key, entry_point.key)
    )
