"""Functions of parameters with operations that have entry points, evaluated in stages.

An operation such as the exact step of a linear equation is machine code compiled once for all
systems. What it takes is computed by generated code, and so is what is made of its results. An
array holds arguments and result of each operation.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytensor.tensor as pt
from llvmlite import ir
from numba import carray, types
from numba.core import cgutils
from pytensor.graph.traversal import io_toposort
from pytensor.tensor.variable import TensorVariable

from ...system.linear_step import LinearStep, LinearStepBack, make_functions
from ..codegen.arguments import PARAMETER_ARGUMENTS
from ..codegen.array_fallback import array_code
from ..codegen.emitter import Emitter
from ..codegen.function_types import Graph, ParameterFunction, jit
from ..codegen.functions import unrolled
from ..codegen.machine_code import DOUBLE, INT, POINTER, Module, ModuleEntryPoint, constant
from ..codegen.scalarize import NotUnrollableError
from ..native.entry_point import F64_PTR, EntryPoint

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


def staged(
    name: str,
    inputs: Sequence[TensorVariable],
    output: TensorVariable,
    take_root: EntryPoint | None = None,
    roots: Sequence[int] = (),
) -> ParameterFunction:
    """The function of the inputs (vectors), in one array, that writes the output, a vector.

    The output ends with matrices of sizes ``roots``, which ``take_root(matrix, size)`` replaces.
    """
    code = _Staged(inputs)
    for node in io_toposort(inputs, [output]):
        if type(node.op) in ENTRY_POINTS:
            code.call(node)
    length, build = output.type.shape[0], code.builder
    code.write(output, code.out)
    start = length - sum(size**2 for size in roots)
    for size in roots:
        assert take_root is not None
        place = build.gep(code.out, [constant(start)])
        code.module.call(build, take_root, [place, constant(size)])
        start += size**2
    build.ret_void()
    entry = ModuleEntryPoint(code.module.finished(), PARAMETER_ARGUMENTS, name)
    return ParameterFunction(entry, length)


class _Staged:
    """The function under construction, and the addresses of the vectors that are known so far."""

    def __init__(self, inputs: Sequence[TensorVariable]) -> None:
        self.module = Module()
        main = self.module.function("main", [POINTER, INT, POINTER])
        given, _, self.out = main.args
        self.builder = ir.IRBuilder(main.append_basic_block())
        self._places: dict[TensorVariable, ir.Value] = {}
        start = 0
        for variable in inputs:
            self._places[variable] = self.builder.gep(given, [constant(start)])
            start += variable.type.shape[0]

    def call(self, node: Any) -> None:
        """An operation on vectors, which follow each other."""
        n_given = sum(v.type.shape[0] for v in node.inputs)
        (result,) = node.outputs
        room = cgutils.alloca_once(
            self.builder, DOUBLE, size=constant(n_given + result.type.shape[0])
        )
        self.write(pt.concatenate(node.inputs), room)
        place = self.builder.gep(room, [constant(n_given)])
        values = [room, place, constant(node.op.n)]
        self.module.call(self.builder, ENTRY_POINTS[type(node.op)], values)
        self._places[result] = place

    def write(self, vector: TensorVariable, place: ir.Value) -> None:
        """Write a vector that is a function of those known so far."""
        build, places = self.builder, list(self._places.values())
        known = {f"v{i}": variable for i, variable in enumerate(self._places)}
        try:
            (values,) = unrolled(Graph(known, [vector]))
        except NotUnrollableError:
            self.module.call(build, _on_arrays(list(self._places), vector), [*places, place])
            return

        def read(name: str) -> ir.Value:
            variable, i = name[1:].split(".")
            return build.load(build.gep(places[int(variable)], [constant(int(i))]))

        emitter = Emitter(self.module, build, read, vector=False)
        for i, value in enumerate(emitter.floats(values)):
            build.store(value, build.gep(place, [constant(i)]))


def _on_arrays(known: Sequence[TensorVariable], vector: TensorVariable) -> EntryPoint:
    """The entry point that writes a vector by array code, NaN where that raises."""
    code, length = array_code(list(known), [vector]), vector.type.shape[0]
    names = [f"v{i}" for i in range(len(known))]
    given = [f"carray({n}, ({v.type.shape[0]},)).copy()" for n, v in zip(names, known, strict=True)]
    source = (
        f"def values({', '.join(names)}, out):\n"
        f"    found = carray(out, ({length},))\n"
        "    try:\n"
        f"        result = code({', '.join(given)})[0]\n"
        "    except Exception:\n"  # a singular matrix, say
        "        found[:] = np.nan\n"
        "    else:\n"
        f"        for i in range({length}):\n"
        "            found[i] = result[i]\n"
    )
    scope = {"np": np, "carray": carray, "code": code.function, "__name__": __name__}
    exec(compile(source, "<values of a state-space system>", "exec"), scope)
    arguments = dict.fromkeys([*names, "out"], F64_PTR)
    return EntryPoint(scope["values"], arguments, "values", (source, code.key))
