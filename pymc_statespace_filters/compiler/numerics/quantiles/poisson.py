"""The Poisson quantile at Φ(z), exact for every mean.

A fast form without branches decides nearly always: the bottom-up sum below a mean of 8, else the
Cornish-Fisher series, where its error cannot move the result across a whole number. The rest is
decided by exact probabilities, summed away from the quantile; the tail that is the smaller one is
compared. From a mean of 1e6 on, the longer series errs less than the rounding of Φ(z).
"""

import numpy as np

from ...native.jit import inlined, njit_internal
from ..exponential import exp
from ..intrinsics import sqrt
from .bottom_up import (
    RARE,
    SMALL,
    UNDECIDED,
    add_upwards,
    found,
    is_surely_zero,
    rows,
    small_quantile,
    start,
)
from .normal import limited, tail
from .series import TWO_PI, deviance, series, short_series, smallest_reached, stirling_error
from .single_precision import ZERO

_LARGE = 1e6


@inlined
def _valid(z, mean):
    return (mean >= 0.0) & (mean < np.inf) & (z == z)


@inlined
def _large_poisson(z, mean):
    """The quantile, or `UNDECIDED`, for a mean from 8 on."""
    offset, error = short_series(z, sqrt(mean), 1.0)
    whole = np.floor(mean)
    x = (mean - whole) + offset
    k = whole + np.floor(x)
    return k if (abs(x - np.rint(x)) > error) & (k >= 0.0) else UNDECIDED


@njit_internal
def _probability(k, mean):
    if k == 0.0:
        return exp(-mean)
    return exp(-stirling_error(k) - deviance(k, mean)) / np.sqrt(TWO_PI * k)


@njit_internal
def _reached(k, z, mean, unused):
    """Whether P(N <= k) >= Φ(z)."""
    term, total = 1.0, 0.0
    if z > 0.0:
        k += 1.0
        first = _probability(k, mean)
        while total + term > total:
            total += term
            k += 1.0
            term *= mean / k
        return first * total <= tail(z)
    first = _probability(k, mean)
    while total + term > total:
        total += term
        term *= k / mean
        k -= 1.0
    return first * total >= tail(-z)


_search = smallest_reached(_reached)


@njit_internal
def exact_poisson(z, mean):
    """The quantile for a valid mean."""
    z = limited(z)
    if mean == 0.0:
        return 0.0
    if mean >= _LARGE:
        whole = np.floor(mean)
        return whole + np.floor((mean - whole) + series(z, np.sqrt(mean), 1.0))
    return _search(mean + z * np.sqrt(mean) + (z * z - 1.0) / 6.0, np.inf, z, mean, 0.0)


@njit_internal
def poisson_quantile(z, mean):
    """The quantile; NaN for z or a mean that is invalid."""
    if not _valid(z, mean):
        return np.nan
    z = limited(z)
    if mean < SMALL:
        k = small_quantile(z, exp(-mean), mean, 0.0)
    else:
        k = _large_poisson(z, mean)
    return exact_poisson(z, mean) if k == UNDECIDED else k


@njit_internal
def _small_block(buffer, z, mean, out, size):
    work = rows()
    for j in range(size):
        i = np.uint64(j)
        m = buffer[mean, i]
        m = np.float32(m if m < SMALL else SMALL)
        start(work, i, np.float32(buffer[z, i]), -m, m, ZERO)
    add_upwards(work, size)
    for j in range(size):
        i = np.uint64(j)
        m, other, k = buffer[mean, i], buffer[out, i], found(work, i)
        buffer[out, i] = k if m < SMALL else other


@njit_internal
def _rare_block(buffer, z, mean, out, size):
    for j in range(size):
        i = np.uint64(j)
        is_zero = is_surely_zero(np.float32(buffer[z, i]), np.float32(buffer[mean, i]))
        buffer[out, i] = 0.0 if is_zero else UNDECIDED


@njit_internal
def poisson_block(buffer, z, mean, out, size):
    """The quantiles of the rows ``z`` and ``mean`` of a buffer, into its row ``out``."""
    n_large = n_rare = n_undecided = 0
    for j in range(size):
        n_large += buffer[mean, np.uint64(j)] >= SMALL
        n_rare += buffer[mean, np.uint64(j)] < RARE
    if n_large > 0:
        for j in range(size):
            i = np.uint64(j)
            m = buffer[mean, i]
            buffer[out, i] = _large_poisson(limited(buffer[z, i]), m if m > SMALL else SMALL)
    if n_rare == size:
        _rare_block(buffer, z, mean, out, size)
    elif n_large < size:
        _small_block(buffer, z, mean, out, size)
    for j in range(size):
        i = np.uint64(j)
        k, is_valid = buffer[out, i], _valid(buffer[z, i], buffer[mean, i])
        k = k if is_valid else np.nan
        n_undecided += k == UNDECIDED
        buffer[out, i] = k
    if n_undecided > 0:
        for j in range(size):
            i = np.uint64(j)
            if buffer[out, i] == UNDECIDED:
                buffer[out, i] = poisson_quantile(buffer[z, i], buffer[mean, i])
