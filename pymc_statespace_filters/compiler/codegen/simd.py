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
from numba.core import cgutils
from pytensor.graph.basic import Variable

from ..native.entry_point import EntryPoint
from .arguments import LANE_ARGUMENTS, LANES
from .emitter import Emitter, depends_on
from .expressions import FLOAT, Expression, Value, in_order
from .function_types import Graph
from .functions import unrolled
from .machine_code import Module, ModuleEntryPoint, constant
from .members import sorted_by_number

PARAMETERS, STATE, INPUTS, TIME, NOISE = "theta", "s", "u", "t", "z"


class LaneFunction(NamedTuple):
    """A graph of vectors, and the names of the vectors that its outputs are written to.

    Its inputs are in lanes, all but the time ``t``, which is the same number for all. It reads
    the state and the inputs of its step, and writes the next state. Any other vector is
    overwritten. ``backwards`` says that the last step comes first.
    """

    graph: Graph
    targets: Sequence[str]
    backwards: bool = False


class Places(NamedTuple):
    """The first row in ``W`` of each vector, the first free row, and lengths of other vectors.

    To a step belong its inputs and, behind them, its noises.
    """

    rows: Mapping[str, int]
    n_rows: int
    state_size: int
    n_inputs: int
    n_observables: int
    n_noises: int = 0

    def of(self, name: str) -> tuple[str, int]:
        """The array that a function of one step reads a vector from, and its first element."""
        of_step = {STATE: ("states", 0), INPUTS: ("forces", 0), NOISE: ("forces", self.n_inputs)}
        return of_step.get(name) or ("W", self.rows[name])


class Written(NamedTuple):
    """A function written out: values, their targets, and the rows of what is read of ``W``."""

    values: Sequence[Value]
    targets: Sequence[tuple[str, int]]
    known: Mapping[Value, int]


def lane_functions(
    functions: Mapping[str, LaneFunction], places: Places
) -> tuple[dict[str, EntryPoint], int]:
    """Entry points with `LANE_ARGUMENTS`, and the number of rows of ``W``.

    The first function is to be called whenever parameters are written to their rows: it also
    computes what the others need of parameters alone. Raises NotUnrollableError where there is no
    scalar form.
    """
    values = {
        name: [v for group in unrolled(function.graph) for v in group]
        for name, function in functions.items()
    }
    written, n_rows = written_out(functions, values, places)
    entries: dict[str, EntryPoint] = {}
    for name, function in functions.items():
        code = _Lanes(places)
        code.emit(written[name], backwards=function.backwards)
        entries[name] = ModuleEntryPoint(code.module.finished(), LANE_ARGUMENTS, name)
    return entries, n_rows


def written_out(
    functions: Mapping[str, LaneFunction],
    values: Mapping[str, Sequence[Value]],
    places: Places,
    *,
    shares: bool = True,
) -> tuple[dict[str, Written], int]:
    """What each function computes, the first also for the others, and the number of rows.

    Unless it ``shares``, each computes alone what depends on parameters alone.
    """
    first, *others = functions
    known: dict[str, dict[Value, int]] = {name: {} for name in functions}
    n_rows = places.n_rows
    for name in others if shares else []:
        for value in constants_of(values[name], functions[name].graph):
            known[name][value] = n_rows
            n_rows += 1
    shared = [item for name in others for item in known[name].items()]
    written = {}
    for name, function in functions.items():
        more = shared if name == first else []
        targets = [*_targets(function, places), *(("W", row) for _, row in more)]
        results = [*values[name], *(value for value, _ in more)]
        written[name] = Written(results, targets, known[name])
    return written, n_rows


def length_of(variable: Variable) -> int:
    """The length of a vector, 1 for a number."""
    return variable.type.shape[0] if variable.type.ndim else 1


def sizes_of(function: LaneFunction) -> list[tuple[str, int]]:
    """Names and lengths of the outputs."""
    outputs = function.graph.outputs
    return [(name, length_of(v)) for name, v in zip(function.targets, outputs, strict=True)]


def _targets(function: LaneFunction, places: Places) -> list[tuple[str, int]]:
    """The array and the element or row that each element of the outputs is written to."""
    found = []
    for name, length in sizes_of(function):
        array, first = places.of(name)
        first += places.state_size if name == STATE else 0  # the next state
        found += [(array, first + i) for i in range(length)]
    return found


def _elements(graph: Graph) -> set[str]:
    return {f"{name}.{i}" for name, v in graph.inputs.items() for i in range(length_of(v))}


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

    def __init__(self, places: Places) -> None:
        self.module, self._rows = Module(), places.rows
        self._sizes = {"W": 0, "states": places.state_size, "forces": places.n_inputs}
        self._builder, self._arguments = self.module.main(LANE_ARGUMENTS)
        self._distinct = self.module.distinct(list(self._sizes))
        self._starts: dict[str, ir.Value] = {}
        self._lane = self._time = None

    def emit(self, written: Written, *, backwards: bool) -> None:
        """Write values to their targets; what is equal in all lanes is computed before."""
        values, targets, known = written
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
