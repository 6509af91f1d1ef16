"""Functions on arrays, for graphs that are too large or have an operation without scalar form.

Linear algebra is in plain loops. A call to BLAS from numba takes seconds to compile, once for every
combination of memory layouts: for a system with 40 states that was nine tenths of the compilation
time. For matrices of that size the loops are about as fast.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pytensor
import pytensor.tensor as pt
from numba import carray
from pytensor.compile.mode import get_mode
from pytensor.graph.basic import Apply, Constant, Variable
from pytensor.graph.fg import FunctionGraph
from pytensor.graph.op import Op
from pytensor.graph.traversal import io_toposort
from pytensor.link.numba.dispatch.basic import (
    numba_funcify_and_cache_key,
    numba_njit,
    register_funcify_and_cache_key,
)
from pytensor.tensor.linalg.decomposition.cholesky import Cholesky
from pytensor.tensor.linalg.products import Expm
from pytensor.tensor.linalg.solvers.psd import CholeskySolve
from pytensor.tensor.linalg.solvers.triangular import SolveTriangular
from pytensor.tensor.math import Dot

from ...errors import LoweringError
from ..native.cache_key import key_of
from ..native.compilation import undamaged_files, warning_filter
from ..native.entry_point import EntryPoint
from .arguments import MEMBER_ARGUMENTS
from .function_types import MEMBER_INPUTS, CompiledFunction, Graph, function_of

# The code that reads a whole input, if not its name.
_WHOLE = {
    "theta": "c", "u": "inputs[k]", "t": "np.asarray(t)",
}  # fmt: skip

# The same where arguments are addresses; others are vectors at z.
_AT_ADDRESS = {
    "theta": "carray(c, ({n},))", "u": "carray(inputs, (k + 1, {n}))[k]", "t": "np.asarray(t)",
    "gains": "carray(out, ({n},))", "x": "carray(X, ({n}, n_members))[:, member].copy()",
    "z": "carray(z, ({n}, width))[:, member].copy()",
}  # fmt: skip


def array_vector_function(name: str, arguments: str, graph: Graph) -> CompiledFunction:
    """A vector function that passes arrays; NaN where the array code raises."""
    used = used_inputs(graph.inputs, graph.outputs)
    compiled = array_code(list(used.values()), graph.outputs)
    results = [f"out[{i}].copy()" for i in range(len(graph.outputs))]
    failed = [f"np.full({output.type.shape[0]}, nan)" for output in graph.outputs]
    body = [
        "try:",
        f"    out = array_code({_whole(used)})",
        f"    return {', '.join(results)}",
        "except Exception:",  # a singular matrix, say
        f"    return {', '.join(failed)}",
    ]
    return _build(name, arguments, body, array_code=compiled)


def array_member_function(name: str, graph: Graph, target: str) -> EntryPoint:
    """A member function that calls array code for each member."""
    members = {n: v for n, v in graph.inputs.items() if n in MEMBER_INPUTS}
    others = {n: v for n, v in graph.inputs.items() if n not in MEMBER_INPUTS}
    common = _frontier(list(graph.inputs.values()), list(members.values()), graph.outputs)
    others, members = used_inputs(others, common), used_inputs(members, graph.outputs)
    before = array_code(list(others.values()), common)
    inside = array_code([*members.values(), *common], graph.outputs)
    calls = [_at_address(members)] * bool(members) + [f"common[{i}]" for i in range(len(common))]
    lines = [
        f"    results = carray({target}, ({graph.outputs[0].type.shape[0]}, n_members))",
        "    try:",
        f"        common = before({_at_address(others)})",
        "    except Exception:",  # a singular matrix, say
        "        results[:] = nan",
        "        return",
        "    for member in range(n_members):",
        "        try:",
        f"            result = inside({', '.join(calls)})[0]",
        "        except Exception:",
        "            results[:, member] = nan",
        "        else:",
        "            for i in range(result.size):",
        "                results[i, member] = result[i]",
    ]
    source = "\n".join([f"def {name}({', '.join(MEMBER_ARGUMENTS)}):", *lines])
    scope = {
        "np": np, "nan": np.nan, "carray": carray, "before": before.function,
        "inside": inside.function, "__name__": __name__,
    }  # fmt: skip
    exec(compile(source, f"<{name} of a state-space system>", "exec"), scope)
    return EntryPoint(scope[name], MEMBER_ARGUMENTS, name, (source, before.key, inside.key))


def _at_address(inputs: Mapping[str, Variable]) -> str:
    sizes = {n: (v.type.shape[0] if v.type.ndim else 1) for n, v in inputs.items()}
    return ", ".join(
        _AT_ADDRESS.get(name, "carray(z, ({n},))").format(n=n) for name, n in sizes.items()
    )


def _build(
    name: str, arguments: str, body: list[str], **parts: CompiledFunction
) -> CompiledFunction:
    namespace = {"np": np, "nan": np.nan} | {
        part: compiled.function for part, compiled in parts.items()
    }
    function, source = function_of(name, arguments, body, namespace)
    keys = (part.key for part in parts.values())
    return CompiledFunction(function, key_of(__name__, source, *keys))


def _whole(inputs: Mapping[str, Variable]) -> str:
    return ", ".join(_WHOLE.get(name, name) for name in inputs)


def used_inputs(inputs: Mapping[str, Variable], outputs: Sequence[Variable]) -> dict[str, Variable]:
    """The inputs that outputs depend on."""
    found = {i for node in io_toposort(list(inputs.values()), outputs) for i in node.inputs}
    found |= set(outputs)
    return {name: variable for name, variable in inputs.items() if variable in found}


def _frontier(
    inputs: list[Variable], members: list[Variable], outputs: Sequence[Variable]
) -> list[Variable]:
    """Variables independent of the members that something dependent on them reads."""
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


def array_code(inputs: list, outputs: Sequence[Variable]) -> CompiledFunction:
    """A graph compiled by PyTensor itself: arrays in, a tuple of arrays out."""
    # Failed parameter checks of PyMC become minus infinity, because a filter must not raise.
    mode = get_mode("NUMBA").including("local_check_parameter_to_ninf_switch")
    # Object mode calls Python from machine code: slow, not cacheable, and it needs the GIL.
    with undamaged_files(), warning_filter("error", "Numba will use object mode"):
        try:
            function = pytensor.function(
                inputs, list(outputs), mode=mode, on_unused_input="ignore", trust_input=True
            )
            graph: FunctionGraph = function.maker.fgraph
            use_loops(graph)
            code, key = numba_funcify_and_cache_key(graph)
        except (NotImplementedError, UserWarning) as error:
            raise LoweringError(
                f"functions of the system must consist of pytensor.tensor operations that numba "
                f"supports, got one that it does not: {error}"
            ) from error
    return CompiledFunction(code, None if key is None else key_of(__name__, str(key)))


@numba_njit
def product(a, b):
    """The matrix product."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                out[i, j] += a[i, k] * b[k, j]
    return out


@numba_njit
def cholesky(a):
    """Lower factor, row by row; a negative pivot gives NaN."""
    n = a.shape[0]
    out = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            rest = a[i, j]
            for k in range(j):
                rest -= out[i, k] * out[j, k]
            out[i, j] = np.sqrt(rest) if i == j else rest / out[j, j]
    return out


@numba_njit
def solve_lower(a, b):
    """Forward substitution, all columns at once."""
    out = np.empty(b.shape)
    for i in range(b.shape[0]):
        for c in range(b.shape[1]):
            out[i, c] = b[i, c]
        for k in range(i):
            for c in range(b.shape[1]):
                out[i, c] -= a[i, k] * out[k, c]
        for c in range(b.shape[1]):
            out[i, c] /= a[i, i]
    return out


@numba_njit
def solve_upper(a, b):
    """Backward substitution, all columns at once."""
    out = np.empty(b.shape)
    for i in range(b.shape[0] - 1, -1, -1):
        for c in range(b.shape[1]):
            out[i, c] = b[i, c]
        for k in range(i + 1, b.shape[0]):
            for c in range(b.shape[1]):
                out[i, c] -= a[i, k] * out[k, c]
        for c in range(b.shape[1]):
            out[i, c] /= a[i, i]
    return out


_N_TERMS, _LARGEST_NORM, _MAX_DOUBLINGS = 14, 0.25, 60  # the next term is below rounding


@numba_njit
def exponential(a):
    """The matrix exponential, by its series for a part of ``a`` that is squared again and again."""
    n, norm, doublings = a.shape[0], 0.0, 0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += abs(a[i, j])
        norm = total if not total <= norm else norm
    while norm > _LARGEST_NORM and doublings < _MAX_DOUBLINGS:
        norm *= 0.5
        doublings += 1
    part, out = np.empty((n, n)), np.eye(n)
    for i in range(n):
        for j in range(n):
            part[i, j] = a[i, j] * 0.5**doublings
    for m in range(_N_TERMS, 0, -1):
        out = product(part, out)
        for i in range(n):
            for j in range(n):
                out[i, j] = out[i, j] / m + (i == j)
    for _ in range(doublings):
        out = product(out, out)
    return out


_FUNCTIONS = (product, cholesky, solve_lower, solve_upper, exponential)
_LOOPS = {f.py_func.__name__: f for f in _FUNCTIONS}


class Loops(Op):
    """One of the functions above on double-precision matrices."""

    __props__ = ("name",)

    def __init__(self, name: str) -> None:
        self.name = name

    def make_node(self, *matrices: Variable) -> Apply:  # noqa: D102
        rows, columns = matrices[0].type.shape[0], matrices[-1].type.shape[1]
        return Apply(self, list(matrices), [pt.matrix(dtype="float64", shape=(rows, columns))])

    def perform(self, node: Apply, inputs: list, output_storage: list) -> None:  # noqa: D102
        output_storage[0][0] = _LOOPS[self.name].py_func(*inputs)


@register_funcify_and_cache_key(Loops)
def _numba_loops(op: Loops, node: Apply | None = None, **kwargs) -> tuple:
    return _LOOPS[op.name], key_of(__name__, op.name)


def use_loops(graph: FunctionGraph) -> None:
    """Replace, in place, the products, exponentials, Cholesky factors and triangular solves."""
    for node in graph.toposort():
        # Slices and the like have no number type.
        kinds = {getattr(v.type, "dtype", None) for v in (*node.inputs, *node.outputs)}
        if kinds == {"float64"}:
            replacement = _written_in_loops(node)
            if replacement is not None:
                graph.replace(node.outputs[0], replacement, import_missing=True)


def _written_in_loops(node: Apply) -> Variable | None:
    op, first, last = node.op, node.inputs[0], node.inputs[-1]
    if isinstance(op, Dot):
        return Loops("product")(first, last)
    if isinstance(op, Expm):
        return Loops("exponential")(first)
    if isinstance(op, Cholesky):
        return Loops("cholesky")(first) if op.lower else Loops("cholesky")(first.T).T
    if isinstance(op, SolveTriangular) and not op.unit_diagonal:
        return _solve(first, last, [op.lower])
    if isinstance(op, CholeskySolve):
        return _solve(first if op.lower else first.T, last, [True, False])
    return None


def _solve(a: Variable, b: Variable, lower: list[bool]) -> Variable:
    """Solve with a triangular matrix, or with it and then its transpose."""
    result = b if b.type.ndim == 2 else b[:, None]
    for i, is_lower in enumerate(lower):
        result = Loops("solve_lower" if is_lower else "solve_upper")(a.T if i else a, result)
    return result if b.type.ndim == 2 else result[:, 0]
