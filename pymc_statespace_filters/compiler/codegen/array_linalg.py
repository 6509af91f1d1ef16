"""Linear algebra of array code as plain loops, in place of calls to BLAS and LAPACK.

A call to BLAS from numba takes seconds to compile, once for every combination of memory layouts.
For a system with 40 states that was nine tenths of the compilation time. For matrices of that size
the loops are about as fast.
"""

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.fg import FunctionGraph
from pytensor.graph.op import Op
from pytensor.link.numba.dispatch.basic import numba_njit, register_funcify_and_cache_key
from pytensor.tensor.linalg.decomposition.cholesky import Cholesky
from pytensor.tensor.linalg.solvers.psd import CholeskySolve
from pytensor.tensor.linalg.solvers.triangular import SolveTriangular
from pytensor.tensor.math import Dot

from ..native.cache_key import key_of


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


_LOOPS = {f.py_func.__name__: f for f in (product, cholesky, solve_lower, solve_upper)}


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
    """Replace, in place, the products, Cholesky factors and triangular solves of a graph."""
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
