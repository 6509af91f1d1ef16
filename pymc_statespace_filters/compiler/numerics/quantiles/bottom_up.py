"""Quantiles of small counts, found by adding probabilities from zero upwards.

The probability of j + 1 is that of j times (a - j b) / (j + 1), with b = 0 for a Poisson law. All
members of a block add four terms at a time, until the sums of all have passed the probability that
is sought. Single precision suffices: where its error might move a result, the result is undecided.
"""

import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.core import cgutils
from numba.extending import intrinsic

from ...native.jit import inlined, njit_internal, njit_reassoc
from ..intrinsics import fma
from .normal import normal_probability
from .single_precision import FOUR, ONE, THREE, TWO, ZERO, exp
from .single_precision import normal_probability as single_normal_probability

SMALL = 8.0
"""Means below are small."""

RARE = 0.0625
"""Where all means of a block are below, its few counts above zero are found one by one."""

UNDECIDED = -1.0

_MOST = np.float32(20.0)  # one in 4000 draws of the largest mean is above
# Of sums and of the probability sought, absolute: twice the largest of 1e8 errors.
_ERROR, _ERROR_OF_EXPONENT = np.float32(3e-6), np.float32(4e-7)
_SCALAR_ERROR = 1e-10

_WIDTH = 64  # members of a block, at most
_A, _B, _TERM, _TOTAL, _LOW, _HIGH, _N_LOW, _N_HIGH = range(0, 8 * _WIDTH, _WIDTH)
_SIZE = 8 * _WIDTH


@intrinsic
def _on_stack(typing_context):
    """The address of the rows of a block, which LLVM knows that nothing else refers to."""

    def code(context, builder, signature, arguments):
        size = ir.Constant(ir.IntType(64), _SIZE)
        return cgutils.alloca_once(builder, ir.FloatType(), size=size)

    return types.CPointer(types.float32)(), code


@inlined
def rows():
    """Room for the sums of a block."""
    return carray(_on_stack(), (_SIZE,))


@inlined
def start(work, i, z, log_first, a, b):
    """Begin the sum of member i with the probability of zero."""
    first, sought = exp(log_first), single_normal_probability(z)
    error = fma(-log_first, _ERROR_OF_EXPONENT, _ERROR)
    work[i + _A], work[i + _B], work[i + _TERM], work[i + _TOTAL] = a, b, first, first
    work[i + _LOW], work[i + _HIGH] = sought - error, sought + error
    work[i + _N_LOW], work[i + _N_HIGH] = ZERO, ZERO


@njit_internal
def _add_four(work, first, size):
    """Count the sums to four numbers from ``first`` on that are below, and add the next terms."""
    j0, j1, j2, j3 = first, first + ONE, first + TWO, first + THREE
    r0, r1, r2, r3 = ONE / (j0 + ONE), ONE / (j1 + ONE), ONE / (j2 + ONE), ONE / (j3 + ONE)
    for j in range(size):
        i = np.uint64(j)
        a, b, low, high = work[i + _A], work[i + _B], work[i + _LOW], work[i + _HIGH]
        term, total = work[i + _TERM], work[i + _TOTAL]
        n_low, n_high = work[i + _N_LOW], work[i + _N_HIGH]
        n_low, n_high = _counted(total, low, n_low), _counted(total, high, n_high)
        term *= fma(-j0, b, a) * r0
        total += term
        n_low, n_high = _counted(total, low, n_low), _counted(total, high, n_high)
        term *= fma(-j1, b, a) * r1
        total += term
        n_low, n_high = _counted(total, low, n_low), _counted(total, high, n_high)
        term *= fma(-j2, b, a) * r2
        total += term
        n_low, n_high = _counted(total, low, n_low), _counted(total, high, n_high)
        term *= fma(-j3, b, a) * r3
        work[i + _TERM], work[i + _TOTAL] = term, total + term
        work[i + _N_LOW], work[i + _N_HIGH] = n_low, n_high


@inlined
def _counted(total, limit, n):
    return n + (ONE if total < limit else ZERO)


@njit_reassoc
def _n_below(work, size):
    n = ZERO
    for j in range(size):
        i = np.uint64(j)
        n += ONE if work[i + _TOTAL] < work[i + _HIGH] else ZERO
    return n


@njit_internal
def add_upwards(work, size):
    """Add terms until the sums of all members have passed what is sought."""
    first = ZERO
    while first < _MOST:
        _add_four(work, first, size)
        if _n_below(work, size) == ZERO:
            break
        first += FOUR


@inlined
def found(work, i):
    """The quantile of member i, or `UNDECIDED`."""
    n, other = work[i + _N_LOW], work[i + _N_HIGH]
    is_decided = (n == other) & (work[i + _TOTAL] >= work[i + _HIGH])
    k = np.float64(n)
    return k if is_decided else UNDECIDED


@inlined
def is_surely_zero(z, mean):
    """Whether the count is zero because the mean, which no P(N > 0) exceeds, is below Φ(-z)."""
    return single_normal_probability(-z) > mean + _ERROR


@njit_internal
def small_quantile(z, first, a, b):
    """The quantile, or `UNDECIDED`, for a single number in double precision."""
    sought = normal_probability(z)
    term, total, before, k = first, first, 0.0, 0.0
    while total < sought and k < 60.0:
        term *= (a - k * b) / (k + 1.0)
        before, total = total, total + term
        k += 1.0
    is_decided = before < sought - _SCALAR_ERROR and total > sought + _SCALAR_ERROR
    return k if is_decided else UNDECIDED
