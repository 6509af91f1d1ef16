"""Small linear algebra on object arrays of scalar expressions.

Two equations are solved by cofactors: one division, and as accurate as elimination. More are
eliminated with partial pivoting. Rows change places by selects, because the code has no branches.
Cofactors of three and more lose accuracy with the square of the condition number: 1e-6 where
elimination loses 1e-9 (random matrices of three rows, condition number 1e8).
"""

from collections.abc import Iterable
from functools import reduce

import numpy as np
import pytensor.scalar as ps
from pytensor.graph.basic import Apply

from .expressions import Arena, Value, is_constant


def inner(arena: Arena, a: Iterable, b: Iterable) -> Value:
    """The inner product of two vectors."""
    products = [arena.apply(ps.mul, x, y) for x, y in zip(a, b, strict=True)]
    return arena.apply(ps.add, *products) if len(products) > 1 else products[0] if products else 0.0


def cholesky(arena: Arena, node: Apply, arguments: list[np.ndarray]) -> list:
    """Row by row; a negative pivot gives NaN through its square root, like LAPACK's wrapper."""
    (a,) = arguments
    chol = _lower_factor(arena, a if node.op.lower else a.T)
    return [chol if node.op.lower else chol.T]


def _lower_factor(arena: Arena, a: np.ndarray) -> np.ndarray:
    """The lower Cholesky factor of a matrix, of which only the lower triangle is read."""
    n = a.shape[0]
    chol = np.full((n, n), 0.0, dtype=object)
    for i in range(n):
        for j in range(i + 1):
            rest = arena.apply(ps.sub, a[i, j], inner(arena, chol[i, :j], chol[j, :j]))
            chol[i, j] = (
                arena.apply(ps.sqrt, rest) if i == j else arena.apply(ps.true_div, rest, chol[j, j])
            )
    return chol


def solve_triangular(arena: Arena, node: Apply, arguments: list[np.ndarray]) -> list:
    """Forward or backward substitution."""
    a, b = arguments
    return [_substitute(arena, a, b, lower=node.op.lower, unit_diagonal=node.op.unit_diagonal)]


def _substitute(
    arena: Arena, a: np.ndarray, b: np.ndarray, *, lower: bool, unit_diagonal: bool = False
) -> np.ndarray:
    n, columns = a.shape[0], b if b.ndim == 2 else b[:, None]
    order = range(n) if lower else range(n - 1, -1, -1)
    out = np.full(columns.shape, 0.0, dtype=object)
    for c in range(columns.shape[1]):
        done: list[int] = []
        for i in order:
            rest = arena.apply(
                ps.sub, columns[i, c], inner(arena, [a[i, k] for k in done], out[done, c])
            )
            out[i, c] = rest if unit_diagonal else arena.apply(ps.true_div, rest, a[i, i])
            done.append(i)
    return out.reshape(b.shape)


def cholesky_solve(arena: Arena, node: Apply, arguments: list[np.ndarray]) -> list:
    """Solve with a matrix of which a Cholesky factor is given."""
    factor, b = arguments
    return [_solve_by_factor(arena, factor if node.op.lower else factor.T, b)]


def _solve_by_factor(arena: Arena, chol: np.ndarray, b: np.ndarray) -> np.ndarray:
    half = _substitute(arena, chol, b, lower=True)
    return _substitute(arena, chol.T, half, lower=False)


def solve(arena: Arena, node: Apply, arguments: list[np.ndarray]) -> list:
    """Solve with a matrix; NaN where it is singular, or not positive definite as stated."""
    a, b = arguments
    kind, i, j = node.op.assume_a, *np.indices(a.shape)
    if kind in ("sym", "her", "pos"):  # one triangle is read
        low, high = np.minimum(i, j), np.maximum(i, j)
        a = a[high, low] if node.op.lower else a[low, high]
    if kind == "pos":
        return [_solve_by_factor(arena, _lower_factor(arena, a), b)]
    if kind == "tridiagonal":
        a = np.where(abs(i - j) <= 1, a, 0.0)
    return [_solve(arena, a, b.reshape(b.shape[0], -1))[0].reshape(b.shape)]


def inverse(arena: Arena, node: Apply, arguments: list[np.ndarray]) -> list:
    """The inverse; NaN where the matrix is singular."""
    (a,) = arguments
    one = np.where(np.eye(a.shape[0], dtype=bool), 1.0, 0.0).astype(object)
    return [_solve(arena, a, one)[0]]


def determinant(arena: Arena, node: Apply, arguments: list[np.ndarray]) -> list:
    """The determinant."""
    (a,) = arguments
    out = np.empty((), dtype=object)
    out[()] = _solve(arena, a, np.empty((a.shape[0], 0), dtype=object))[1]
    return [out]


def _solve(arena: Arena, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, Value]:
    """The solutions for the columns of b, and the determinant of a."""
    if a.shape[0] == 2:
        return _by_cofactors(arena, a, b)
    upper, right, det = _eliminate(arena, a, b)
    if not b.size:
        return right, det
    for i in range(len(upper)):
        upper[i, i] = _unless_zero(arena, upper[i, i])
    return _substitute(arena, upper, right, lower=False), det


def _by_cofactors(arena: Arena, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, Value]:
    def cross(p: Value, q: Value, r: Value, s: Value) -> Value:
        return arena.apply(ps.sub, arena.apply(ps.mul, p, q), arena.apply(ps.mul, r, s))

    det = cross(a[0, 0], a[1, 1], a[0, 1], a[1, 0])
    scale = arena.apply(ps.true_div, 1.0, _unless_zero(arena, det))
    out = np.empty(b.shape, dtype=object)
    for c in range(b.shape[1]):
        out[0, c] = arena.apply(ps.mul, cross(a[1, 1], b[0, c], a[0, 1], b[1, c]), scale)
        out[1, c] = arena.apply(ps.mul, cross(a[0, 0], b[1, c], a[1, 0], b[0, c]), scale)
    return out, det


def _eliminate(arena: Arena, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, Value]:
    """Upper triangular equations with the same solutions, and the determinant."""
    n, rows = a.shape[0], np.concatenate([a, b], axis=1)
    signs: list[Value] = []
    for k in range(n):
        for i in range(k + 1, n):
            larger = _is_larger(arena, rows[i, k], rows[k, k])
            signs.append(arena.apply(ps.switch, larger, -1.0, 1.0))
            for j in range(k, rows.shape[1]):
                top, low = rows[k, j], rows[i, j]
                rows[k, j] = arena.apply(ps.switch, larger, low, top)
                rows[i, j] = arena.apply(ps.switch, larger, top, low)
        for i in range(k + 1, n):
            # Where the pivot is zero, so is all below it.
            factor = arena.apply(ps.true_div, rows[i, k], _unless_zero(arena, rows[k, k], 1.0))
            for j in range(k + 1, rows.shape[1]):
                product = arena.apply(ps.mul, factor, rows[k, j])
                rows[i, j] = arena.apply(ps.sub, rows[i, j], product)
    det = reduce(lambda p, q: arena.apply(ps.mul, p, q), [*rows.diagonal(), *signs])
    return rows[:, :n], rows[:, n:], det


def _is_larger(arena: Arena, a: Value, b: Value) -> Value:
    """Whether a is the better pivot; any is better than a constant zero, which never is."""
    if is_constant(a) and a == 0:
        return False
    if is_constant(b) and b == 0:
        return True
    return arena.apply(ps.gt, arena.apply(ps.abs, a), arena.apply(ps.abs, b))


def _unless_zero(arena: Arena, value: Value, other: float = float("nan")) -> Value:
    """Another number in place of zero: NaN, so that a singular matrix has no solution."""
    return arena.apply(ps.switch, arena.apply(ps.eq, value, 0.0), other, value)
