"""Vector functions for several parameter points at once, as SIMD code.

Each point occupies a lane. All numbers of all lanes are in one flat array ``W`` of rows of `LANES`:
the parameters, the vector ``s``, a last number, and what depends on parameters alone, which is
computed once. Row offsets are constants of the source, so LLVM knows that rows do not overlap. The
number of lanes is a variable, because LLVM would unroll a short loop of known length instead of
vectorising it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pymc_statespace_filters.compiler.codegen.expressions import FLOAT, Expression, Value
from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction, VectorFunction
from pymc_statespace_filters.compiler.codegen.functions import build, sorted_by_number, unrolled
from pymc_statespace_filters.compiler.codegen.source import VECTOR_NAMESPACE, Writer, depends_on
from pymc_statespace_filters.compiler.native.cache_key import key_of

LANES = 16  # at most
LANES_AT_ONCE = 8  # the number of lanes is a multiple of this

_SHARED = {"u": "inputs[k, {i}]", "t": "t", "d": "d[{i}]"}
_ARGUMENTS = "W, n_lanes, inputs, k, t, d"


@dataclass(frozen=True)
class Lanes:
    """Compiled functions ``name(W, n_lanes, inputs, k, t, d)``, and the layout of ``W``.

    Rows ``i`` hold theta, rows ``n_theta + i`` the vector ``s``, the row ``last`` the result beside
    ``s``. The functions in ``prepare`` must be called after theta is written to its rows.
    """

    functions: Mapping[str, Any]
    prepare: Sequence[Any]
    last: int
    n_rows: int
    key: str | None


def lane_functions(functions: Mapping[str, VectorFunction], size: int) -> Lanes:
    """Compile functions for lanes; raises NotUnrollableError where there is no scalar form."""
    n_theta = next(iter(functions.values())).graph.inputs["theta"].type.shape[0]
    last = n_theta + size
    n_rows = last + 1
    built: dict[str, CompiledFunction] = {}
    prepare: dict[str, CompiledFunction] = {}
    for name, function in functions.items():
        values = [v for group in unrolled(function.graph) for v in group]
        code = _element_code(function, n_theta)
        constants = _constants(values, code)
        rows = {v: _row(n_rows + i) for i, v in enumerate(constants)}
        prepare[name] = _function(f"prepare_{name}", code, {}, constants, list(rows.values()))
        targets = [_row(n_theta + i) for i in range(size)] + [_row(last)]
        built[name] = _function(name, code, rows, values, targets[: len(values)])
        n_rows += len(constants)
    return Lanes(
        {name: compiled.function for name, compiled in built.items()},
        [compiled.function for compiled in prepare.values()],
        last,
        n_rows,
        key_of(f"{LANES} lanes", *(c.key for c in (*built.values(), *prepare.values()))),
    )


def _row(row: int) -> str:
    return f"W[{row * LANES} + lane]"


def _element_code(function: VectorFunction, n_theta: int) -> dict[str, str]:
    first = {"theta": 0, "s": n_theta}
    return {
        f"{name}.{i}": _SHARED[name].format(i=i) if name in _SHARED else _row(first[name] + i)
        for name, variable in function.graph.inputs.items()
        for i in range(variable.type.shape[0] if variable.type.ndim else 1)
    }


def _named(code: Mapping[str, str], *inputs: str) -> frozenset[str]:
    return frozenset(key for key in code if key.partition(".")[0] in inputs)


def _constants(values: Sequence[Value], code: Mapping[str, str]) -> list[Value]:
    """Expressions of theta alone that are results, or are used by others."""
    varying = depends_on(values, _named(code, "s", "u", "t", "d"))
    of_theta = depends_on(values, _named(code, "theta")) - varying
    used = [*values, *(a for e in varying for a in e.args)]
    kept = {v for v in used if v in of_theta and v.op is not None and v.kind == FLOAT}
    return sorted_by_number(kept)


def _function(
    name: str,
    code: dict[str, str],
    known: Mapping[Value, str],
    values: Sequence[Value],
    targets: Sequence[str],
) -> CompiledFunction:
    """Write ``values`` to ``targets`` in every lane; what is equal in all is computed before."""
    writer = Writer(code, VECTOR_NAMESPACE, known)
    of_lane = depends_on(values, _named(code, "theta", "s"))
    used = [*values, *(a for e in of_lane if e.op is not None for a in e.args)]
    shared = sorted_by_number({v for v in used if isinstance(v, Expression) and v not in of_lane})
    before, names = writer.statements(shared), [writer.name(v) for v in shared]
    before.append(f"return ({''.join(f'{name}, ' for name in names)})")
    inside = [f"{name} = shared[{i}]" for i, name in enumerate(names)]
    inside += writer.statements(values)
    inside += [f"{t} = {writer.as_float(v)}" for t, v in zip(targets, values, strict=True)]
    inputs = f"{_ARGUMENTS}, lane, shared"
    body = [
        f"shared = before({_ARGUMENTS})",
        "for lane in range(n_lanes):",
        f"    inside({inputs})",
    ]
    blocks = {"before": (_ARGUMENTS, before), "inside": (inputs, inside)}
    return build(name, _ARGUMENTS, body, writer, **blocks)
