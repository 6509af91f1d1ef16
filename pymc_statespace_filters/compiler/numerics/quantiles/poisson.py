"""The Poisson quantile at Φ(z), exact for every mean.

A fast form without branches decides nearly always: the bottom-up sum below a mean of 8, else the
Cornish-Fisher series, where its error cannot move the result across a whole number. The rest is
decided by exact probabilities, summed away from the quantile; the tail that is the smaller one is
compared. From a mean of 1e6 on, the longer series errs less than the rounding of Φ(z).
"""

import numpy as np

from pymc_statespace_filters.compiler.native.jit import inlined, njit_internal
from pymc_statespace_filters.compiler.numerics.exponential import exp
from pymc_statespace_filters.compiler.numerics.intrinsics import sqrt
from pymc_statespace_filters.compiler.numerics.quantiles.bottom_up import (
    UNDECIDED,
    count_poisson,
    limits,
)
from pymc_statespace_filters.compiler.numerics.quantiles.normal import limited, tail
from pymc_statespace_filters.compiler.numerics.quantiles.saddle_point import (
    TWO_PI,
    deviance,
    smallest_reached,
    stirling_error,
)
from pymc_statespace_filters.compiler.numerics.quantiles.series import series, short_series

_SMALL, _LARGE = 8.0, 1e6


@inlined
def fast_poisson(z, mean):
    """The quantile, or `UNDECIDED`; NaN for z or a mean that is invalid."""
    z = limited(z)
    small_mean = mean if mean < _SMALL else _SMALL
    low, high = limits(z, small_mean)
    small = count_poisson(small_mean, low, high)
    large_mean = mean if mean > _SMALL else _SMALL
    offset, error = short_series(z, sqrt(large_mean), 1.0)
    whole = np.floor(large_mean)
    x = (large_mean - whole) + offset
    large = whole + np.floor(x)
    decided = (abs(x - np.rint(x)) > error) & (large >= 0.0)
    large = large if decided else UNDECIDED
    result = small if mean < _SMALL else large
    valid = (mean >= 0.0) & (mean < np.inf) & (z == z)
    return result if valid else np.nan


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
    k = fast_poisson(z, mean)
    return exact_poisson(z, mean) if k == UNDECIDED else k
