"""Vector functions of a state in SIMD lanes: several evaluations side by side, each in a lane.

The numbers of all lanes are in flat arrays of rows of `LANES`, a row for each element of a vector.
``W`` has the parameters, the other vectors, and below these expressions of parameters alone, which
are computed once. ``states`` has the states of successive steps, and ``forces`` the inputs. Row
offsets are constants of the source, so LLVM knows that rows do not overlap. The number of lanes is
a variable, because LLVM would unroll a short loop of known length instead of vectorising it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from numba import types

from pymc_statespace_filters.compiler.codegen.expressions import FLOAT, Expression, Value
from pymc_statespace_filters.compiler.codegen.function_types import Graph
from pymc_statespace_filters.compiler.codegen.functions import (
    blocks_of,
    sorted_by_number,
    unrolled,
)
from pymc_statespace_filters.compiler.codegen.source import VECTOR_NAMESPACE, Writer, depends_on
from pymc_statespace_filters.compiler.native.entry_point import (
    F64_PTR,
    EntryPoint,
    arguments_class,
)

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
    code = {name: _element_code(function.graph, rows) for name, function in functions.items()}
    known: dict[str, dict[Value, str]] = {first: {}}
    for name in others:
        constants = _constants(values[name], code[name])
        known[name] = {v: _row(n_rows + i) for i, v in enumerate(constants)}
        n_rows += len(constants)
    entries = {}
    for name, function in functions.items():
        results, targets = values[name], _targets(function, rows, state_size)
        given = code[name]
        if name == first:
            for other in others:
                results, targets = [*results, *known[other]], [*targets, *known[other].values()]
                given = given | code[other]
        blocks, key = _blocks(given, known[name], results, targets)
        sizes = state_size * LANES, n_inputs * LANES
        loop = _loop(blocks["before"], blocks["inside"], *sizes, backwards=function.backwards)
        parts = (repr((LANES, sizes, function.backwards)), key)
        entries[name] = EntryPoint(loop, LANE_ARGUMENTS, name, parts)
    return LaneFunctions(entries, n_rows)


def _row(row: int) -> str:
    return f"W[{row * LANES} + lane]"


def _element_code(graph: Graph, rows: Mapping[str, int]) -> dict[str, str]:
    """The code that reads each element of the inputs."""
    places = {STATE: "states[state + {} + lane]", INPUTS: "forces[force + {} + lane]", TIME: TIME}
    return {
        f"{name}.{i}": places[name].format(i * LANES) if name in places else _row(rows[name] + i)
        for name, variable in graph.inputs.items()
        for i in range(variable.type.shape[0] if variable.type.ndim else 1)
    }


def _targets(function: LaneFunction, rows: Mapping[str, int], state_size: int) -> list[str]:
    """Where each element of the outputs is written."""
    return [
        f"states[state + {(state_size + i) * LANES} + lane]"
        if name == STATE
        else _row(rows[name] + i)
        for name, output in zip(function.targets, function.graph.outputs, strict=True)
        for i in range(output.type.shape[0])
    ]


def _constants(values: Sequence[Value], code: Mapping[str, str]) -> list[Value]:
    """Expressions of theta alone that are results, or are used by others."""
    of_theta = frozenset(name for name in code if name.partition(".")[0] == PARAMETERS)
    varying = depends_on(values, frozenset(code) - of_theta)
    constant = depends_on(values, of_theta) - varying
    used = [*values, *(a for e in varying for a in e.args)]
    kept = {v for v in used if v in constant and v.op is not None and v.kind == FLOAT}
    return sorted_by_number(kept)


_INSIDE = "W, states, state, forces, force, t, lane, shared"


def _blocks(
    code: Mapping[str, str],
    known: Mapping[Value, str],
    values: Sequence[Value],
    targets: Sequence[str],
) -> tuple[dict[str, Any], str | None]:
    """Code that writes ``values`` to ``targets``; what is equal in all lanes is computed before."""
    writer = Writer(dict(code), VECTOR_NAMESPACE, known)
    of_lane = depends_on(values, frozenset(code) - {f"{TIME}.0"})
    used = [*values, *(a for e in of_lane if e.op is not None for a in e.args)]
    shared = sorted_by_number({v for v in used if isinstance(v, Expression) and v not in of_lane})
    before, names = writer.statements(shared), [writer.name(v) for v in shared]
    before.append(f"return ({''.join(f'{name}, ' for name in names)})")
    inside = [f"{name} = shared[{i}]" for i, name in enumerate(names)]
    inside += writer.statements(values)
    inside += [f"{t} = {writer.as_float(v)}" for t, v in zip(targets, values, strict=True)]
    return blocks_of(writer, before=(TIME, before), inside=(_INSIDE, inside))


def _loop(
    before: Any, inside: Any, state_size: int, force_size: int, *, backwards: bool
) -> Callable:
    """The loops over steps and lanes; the function of an entry point."""

    def run(W, n_lanes, states, forces, t0, dt, k, n_steps):
        for number in range(n_steps):
            i = n_steps - 1 - number if backwards else number
            t = t0 + (k + i) * dt
            shared = before(t)
            for lane in range(n_lanes):
                inside(W, states, i * state_size, forces, i * force_size, t, lane, shared)

    return run
