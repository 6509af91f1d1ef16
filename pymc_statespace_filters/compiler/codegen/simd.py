"""Vector functions of a state in SIMD lanes: several evaluations side by side, each in a lane.

The numbers of all lanes are in flat arrays of rows of `LANES`, a row for each element of a vector.
``W`` has the parameters, the other vectors, and below these expressions of parameters alone, which
are computed once. ``states`` has the states of successive steps, and ``forces`` the inputs. Row
offsets are constants of the source, so LLVM knows that rows do not overlap. The number of lanes is
a variable, because LLVM would unroll a short loop of known length instead of vectorising it.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.core import cgutils

from ..native.entry_point import F64_PTR, EntryPoint, arguments_class
from .emitter import Emitter, depends_on
from .expressions import FLOAT, Expression, Value, in_order
from .function_types import Graph
from .functions import unrolled
from .machine_code import Module, ModuleEntryPoint, constant
from .members import LLVM_TYPES, sorted_by_number

LANES = 32  # at most
LANES_AT_ONCE = 8  # the number of lanes is a multiple of this

LANE_ARGUMENTS = {
    "W": F64_PTR, "n_lanes": types.intp, "states": F64_PTR, "forces": F64_PTR, "t0": types.float64,
    "dt": types.float64, "k": types.intp, "n_steps": types.intp,
}  # fmt: skip
"""Of a function of the steps k to k + n_steps - 1, whose states and inputs come first."""

LaneArguments = arguments_class("LaneArguments", LANE_ARGUMENTS, __name__)

PARAMETERS, STATE, INPUTS, TIME = "theta", "s", "u", "t"


class LaneFunction(NamedTuple):
    """A graph of vectors, and the names of the vectors that its outputs are written to.

    Its inputs are in lanes, all but the time ``t``, which is the same number for all. It reads
    the state and the inputs of its step, and writes the next state. Any other vector is
    overwritten. ``backwards`` says that the last step comes first.
    """

    graph: Graph
    targets: Sequence[str]
    backwards: bool = False


class LaneFunctions(NamedTuple):
    """Entry points with `LANE_ARGUMENTS`, and the number of rows of ``W``."""

    entries: Mapping[str, EntryPoint]
    n_rows: int


def lane_functions(
    functions: Mapping[str, LaneFunction],
    rows: Mapping[str, int],
    n_rows: int,
    state_size: int,
    n_inputs: int,
) -> LaneFunctions:
    """Write functions out for lanes; raises NotUnrollableError where there is no scalar form.

    ``rows`` has the first row in ``W`` of each vector, and ``n_rows`` is the first that is free.
    The first function is to be called whenever parameters are written to their rows: it also
    computes what the others need of parameters alone.
    """
    first, *others = functions
    values = {
        name: [v for group in unrolled(function.graph) for v in group]
        for name, function in functions.items()
    }
    known: dict[str, dict[Value, int]] = {first: {}}
    for name in others:
        constants = constants_of(values[name], functions[name].graph)
        known[name] = {v: n_rows + i for i, v in enumerate(constants)}
        n_rows += len(constants)
    entries = {}
    for name, function in functions.items():
        results, targets = values[name], _targets(function, rows, state_size)
        if name == first:
            for other in others:
                results = [*results, *known[other]]
                targets = [*targets, *(("W", row) for row in known[other].values())]
        code = _Lanes(rows, state_size, n_inputs)
        code.emit(results, targets, known[name], backwards=function.backwards)
        entries[name] = ModuleEntryPoint(code.module.finished(), LANE_ARGUMENTS, name)
    return LaneFunctions(entries, n_rows)


def _elements(graph: Graph) -> set[str]:
    return {
        f"{name}.{i}"
        for name, variable in graph.inputs.items()
        for i in range(variable.type.shape[0] if variable.type.ndim else 1)
    }


def _targets(
    function: LaneFunction, rows: Mapping[str, int], state_size: int
) -> list[tuple[str, int]]:
    """The array and row that each element of the outputs is written to."""
    return [
        ("states", state_size + i) if name == STATE else ("W", rows[name] + i)
        for name, output in zip(function.targets, function.graph.outputs, strict=True)
        for i in range(output.type.shape[0])
    ]


def constants_of(values: Sequence[Value], graph: Graph) -> list[Expression]:
    """Expressions of theta alone that are results, or are used by others."""
    elements = _elements(graph)
    of_theta = frozenset(name for name in elements if name.partition(".")[0] == PARAMETERS)
    varying = depends_on(values, frozenset(elements) - of_theta)
    constant = depends_on(values, of_theta) - varying
    used = [*values, *(a for e in varying for a in e.args)]
    kept = {v for v in used if v in constant and v.op is not None and v.kind == FLOAT}
    return sorted_by_number(kept)


class _Lanes:
    """A function with `LANE_ARGUMENTS` under construction: loops over steps and lanes."""

    def __init__(self, rows: Mapping[str, int], state_size: int, n_inputs: int) -> None:
        self.module, self._rows = Module(), rows
        self._sizes = {"W": 0, "states": state_size, "forces": n_inputs}
        main = self.module.function("main", [LLVM_TYPES[k] for k in LANE_ARGUMENTS.values()])
        self._arguments = dict(zip(LANE_ARGUMENTS, main.args, strict=True))
        self._builder = ir.IRBuilder(main.append_basic_block())
        self._distinct = self.module.distinct(list(self._sizes))
        self._starts: dict[str, ir.Value] = {}
        self._lane = self._time = None

    def emit(
        self,
        values: Sequence[Value],
        targets: Sequence[tuple[str, int]],
        known: Mapping[Value, int],
        *,
        backwards: bool,
    ) -> None:
        """Write ``values`` to ``targets``; what is equal in all lanes is computed before.

        The ``known`` are read from their rows of ``W``.
        """
        build, given = self._builder, self._arguments
        emitter = Emitter(self.module, build, self._read, vector=True)
        with cgutils.for_range(build, given["n_steps"]) as loop:
            i = loop.index
            if backwards:
                i = build.sub(build.sub(given["n_steps"], constant(1)), i)
            step = build.sitofp(build.add(given["k"], i), given["t0"].type)
            elapsed = emitter.arithmetic("fmul", step, given["dt"])
            self._time = emitter.arithmetic("fadd", given["t0"], elapsed)
            self._starts = {
                name: build.gep(given[name], [build.mul(i, constant(size * LANES))])
                for name, size in self._sizes.items()
            }
            shared = self._shared(values)
            emitter.emit(shared)
            with cgutils.for_range(build, given["n_lanes"]) as lanes:
                self._lane = lanes.index
                for expression, row in known.items():
                    emitter.set(expression, self._load("W", row))
                results = emitter.floats(values)
                for (name, row), result in zip(targets, results, strict=True):
                    self._marked(build.store(result, self._place(name, row)), name)
        build.ret_void()

    def _shared(self, values: Sequence[Value]) -> list[Expression]:
        """What depends on the time alone and is read in the lanes."""
        inputs = frozenset(e.args[0] for e in in_order(values, ()) if e.op is None)
        of_lane = depends_on(values, inputs - {f"{TIME}.0"})
        used = [*values, *(a for e in of_lane if e.op is not None for a in e.args)]
        return sorted_by_number({v for v in used if v not in of_lane})

    def _read(self, name: str) -> ir.Value:
        vector, _, number = name.partition(".")
        if vector == TIME:
            return self._time
        where = {STATE: "states", INPUTS: "forces"}.get(vector)
        if where is not None:
            return self._load(where, int(number))
        return self._load("W", self._rows[vector] + int(number))

    def _load(self, name: str, row: int) -> ir.Value:
        return self._marked(self._builder.load(self._place(name, row)), name)

    def _place(self, name: str, row: int) -> ir.Value:
        at = self._builder.add(constant(row * LANES), self._lane)
        return self._builder.gep(self._starts[name], [at], inbounds=True)

    def _marked(self, instruction: Any, name: str) -> Any:
        for mark, metadata in self._distinct[name].items():
            instruction.set_metadata(mark, metadata)
        return instruction
