"""Cholesky factors, triangular solves and the Gaussian log-density of small matrices, in place.

The factorisations differ on purpose. `covariance_root` takes covariances given by the user, and
returns NaN for a matrix that is no covariance. `codegen.scalarize` and `codegen.array_fallback`
implement PyTensor's Cholesky in generated code, with its conventions.
"""

import math

import numpy as np

from ..native.jit import inline_always, njit_generated, njit_internal

LOG_TWO_PI = math.log(2.0 * math.pi)

# A smaller pivot, relative to its variance, is rounding of a singular matrix. The second is larger:
# dropping a direction is better than dividing by an inaccurate pivot.
_STRICT, _SEMIDEFINITE = 1e-14, 1e-12


@inline_always
def _eliminate(A, j):
    """Pivot j of A, whose columns before j are factored."""
    pivot = A[j, j]
    for k in range(j):
        pivot -= A[j, k] * A[j, k]
    return pivot


@inline_always
def _scale_column(A, j, root):
    """Write column j of the factor on and below the diagonal, and zeros above."""
    n = A.shape[0]
    A[j, j] = root
    for i in range(j + 1, n):
        below = A[i, j]
        for k in range(j):
            below -= A[i, k] * A[j, k]
        A[i, j] = below / root
        A[j, i] = 0.0


@njit_internal
def cholesky(A):
    """Replace A by its lower Cholesky factor; False, with A in parts, if not positive definite."""
    for j in range(A.shape[0]):
        pivot = _eliminate(A, j)
        if not (pivot > _STRICT * A[j, j] and pivot < np.inf):
            return False
        _scale_column(A, j, math.sqrt(pivot))
    return True


@njit_internal
def semidefinite_cholesky(A, floor, active):
    """Replace A by a lower factor in which directions without variance have a zero column.

    Direction j has no variance if its pivot does not exceed rounding or ``floor[j]``; ``active[j]``
    is then False. Returns False if A holds NaN or infinity.
    """
    for j in range(A.shape[0]):
        pivot = _eliminate(A, j)
        if not (pivot > -np.inf and pivot < np.inf):
            return False
        active[j] = pivot > _SEMIDEFINITE * A[j, j] and pivot > floor[j]
        if active[j]:
            _scale_column(A, j, math.sqrt(pivot))
        else:
            for i in range(j, A.shape[0]):
                A[i, j] = A[j, i] = 0.0
    return True


@njit_generated
def covariance_root(a):
    """Lower square root in place; a zero pivot gives a zero column, a negative one NaN.

    Covariances without spread in some direction are ordinary here: a known initial state, noise
    that acts on the velocity alone. Zero is relative to the variance of the component: one may be
    in pascals, the next in metres.
    """
    n = a.shape[0]
    variance = np.empty(n)
    for j in range(n):
        variance[j] = a[j, j]
    for j in range(n):
        pivot = a[j, j]
        for k in range(j):
            pivot -= a[j, k] ** 2
        if pivot < -1e-10 * abs(variance[j]) or not np.isfinite(pivot):
            a[:] = np.nan
            return
        root = np.sqrt(pivot) if pivot > 1e-14 * variance[j] else 0.0
        a[j, j] = root
        for i in range(j + 1, n):
            rest = a[i, j]
            for k in range(j):
                rest -= a[i, k] * a[j, k]
            if root > 0.0:
                a[i, j] = rest / root
            elif abs(rest) > 1e-7 * np.sqrt(variance[i] * variance[j]):
                a[:] = np.nan
                return
            else:
                a[i, j] = 0.0
        for i in range(j):
            a[i, j] = 0.0


@njit_internal
def solve_lower(L, b):
    """Replace b by L^-1 b."""
    for i in range(b.size):
        for k in range(i):
            b[i] -= L[i, k] * b[k]
        b[i] /= L[i, i]


@njit_internal
def solve_lower_transposed(L, b):
    """Replace b by L^-T b."""
    for i in range(b.size - 1, -1, -1):
        for k in range(i + 1, b.size):
            b[i] -= L[k, i] * b[k]
        b[i] /= L[i, i]


@njit_internal
def log_gaussian(r, L, n_dims):
    """log N(r; 0, L L^T) of ``n_dims`` components; r is overwritten.

    A missing component has a zero in r and a row and column of the identity in L.
    """
    solve_lower(L, r)
    total = -0.5 * n_dims * LOG_TWO_PI
    for i in range(r.size):
        total -= 0.5 * r[i] * r[i] + math.log(L[i, i])
    return total
