"""Lower root of a covariance that may be singular, with its derivative.

A known initial state, or noise on the velocity alone, has no spread in some directions. Their
columns of the root are zero, where an ordinary Cholesky factor would be NaN. The derivative treats
them as constant: a covariance that depends smoothly on parameters does not leave the positive
semidefinite matrices on either side, so to first order such a direction gains no spread.
"""

import numpy as np
import pytensor.scalar as ps
import pytensor.tensor as pt
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.op import Op
from pytensor.link.numba.dispatch.basic import numba_njit, register_funcify_and_cache_key
from pytensor.tensor.linalg import solve_triangular
from pytensor.tensor.variable import TensorVariable

from ..native.cache_key import key_of
from .expressions import Arena

# Relative to the variance of the component. A pivot below the first is rounding of zero; one below
# minus the second belongs to no covariance.
ZERO, NEGATIVE = 1e-13, 1e-8


@numba_njit
def semidefinite_cholesky(a):
    """Lower root of a matrix, of which it reads the lower triangle; NaN if it is no covariance."""
    n = a.shape[0]
    out = np.zeros((n, n))
    for j in range(n):
        pivot = a[j, j]
        for k in range(j):
            pivot -= out[j, k] * out[j, k]
        if pivot > ZERO * a[j, j]:
            out[j, j] = np.sqrt(pivot)
            for i in range(j + 1, n):
                rest = a[i, j]
                for k in range(j):
                    rest -= out[i, k] * out[j, k]
                out[i, j] = rest / out[j, j]
        elif not pivot >= -NEGATIVE * a[j, j]:
            out[j, j] = np.nan
    return out


class SemidefiniteCholesky(Op):
    """``semidefinite_cholesky`` of a matrix in double precision."""

    __props__ = ()

    def make_node(self, a: Variable) -> Apply:  # noqa: D102
        return Apply(self, [a], [pt.matrix(dtype="float64", shape=a.type.shape)])

    def perform(self, node: Apply, inputs: list, output_storage: list) -> None:  # noqa: D102
        output_storage[0][0] = semidefinite_cholesky.py_func(inputs[0])

    def pullback(self, inputs: list, outputs: list, cotangents: list) -> list:
        """As of a Cholesky factor (Murray 2016, arXiv:1602.07527), zero columns left out."""
        root, (cotangent,) = outputs[0], cotangents
        regular = pt.neq(pt.diagonal(root), 0.0)
        factor = regular_factor(root)
        inner = pt.tril(factor.T @ (cotangent * regular[None, :]))
        inner = inner - pt.diag(pt.diagonal(inner) / 2.0)
        half = solve_triangular(factor.T, inner.T, lower=False, b_ndim=2)
        whole = solve_triangular(factor.T, half.T, lower=False, b_ndim=2)
        return [pt.tril(whole + whole.T) - pt.diag(pt.diagonal(whole))]


def semidefinite_root(cov: TensorVariable) -> TensorVariable:
    """The lower root of a covariance; column i is zero where component i has no spread of its own.

    "Of its own" means given the components before it.
    """
    return SemidefiniteCholesky()(cov)


def regular_factor(root: TensorVariable) -> TensorVariable:
    """A root with ones on the diagonal in place of zeros, so that it can be solved with."""
    return root + pt.diag(pt.cast(pt.eq(pt.diagonal(root), 0.0), "float64"))


def unrolled_root(arena: Arena, node: Apply, arguments: list[np.ndarray]) -> list:
    """The same on scalar expressions."""
    (a,) = arguments
    n = a.shape[0]
    root = np.full((n, n), 0.0, dtype=object)

    def rest(i: int, j: int):
        left = a[i, j]
        for k in range(j):
            left = arena.apply(ps.sub, left, arena.apply(ps.mul, root[i, k], root[j, k]))
        return left

    for j in range(n):
        pivot = rest(j, j)
        has_spread = arena.apply(ps.gt, pivot, arena.apply(ps.mul, ZERO, a[j, j]))
        is_zero = arena.apply(ps.ge, pivot, arena.apply(ps.mul, -NEGATIVE, a[j, j]))
        other = arena.apply(ps.switch, is_zero, 0.0, float("nan"))
        root[j, j] = arena.apply(ps.switch, has_spread, arena.apply(ps.sqrt, pivot), other)
        for i in range(j + 1, n):
            scaled = arena.apply(ps.true_div, rest(i, j), root[j, j])
            root[i, j] = arena.apply(ps.switch, has_spread, scaled, 0.0)
    return [root]


@register_funcify_and_cache_key(SemidefiniteCholesky)
def _numba_root(op: SemidefiniteCholesky, node: Apply | None = None, **kwargs) -> tuple:
    return semidefinite_cholesky, key_of(__name__)
