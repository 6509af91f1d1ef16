"""The binomial quantile at Φ(z), exact for every number of trials and probability.

By the methods of `poisson`, for the rarer of success and failure.
"""

import numpy as np

from pymc_statespace_filters.compiler.native.jit import inlined, njit_internal
from pymc_statespace_filters.compiler.numerics.exponential import exp, log1p
from pymc_statespace_filters.compiler.numerics.intrinsics import fma, sqrt
from pymc_statespace_filters.compiler.numerics.quantiles.bottom_up import (
    UNDECIDED,
    count_binomial,
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
def _rarer(z, p):
    """(z, p) of the rarer outcome, and whether that is failure."""
    flipped = p > 0.5
    return -z if flipped else z, 1.0 - p if flipped else p, flipped


@inlined
def fast_binomial(z, n, p):
    """The quantile, or `UNDECIDED`; NaN for z or parameters that are invalid."""
    valid = (n >= 0.0) & (n < np.inf) & (np.floor(n) == n) & (p >= 0.0) & (p <= 1.0) & (z == z)
    z, p, flipped = _rarer(limited(z), p)
    q = 1.0 - p
    mean = n * p
    is_small = mean < _SMALL
    small_p = p if is_small else 0.0
    low, high = limits(z, -n * log1p(-small_p))
    small = count_binomial(n, small_p / (1.0 - small_p), low, high)
    variance = mean * q
    deviation = sqrt(2.0 if variance < 2.0 else variance)
    offset, error = short_series(z, deviation, q - p)
    whole = np.floor(mean)
    x = ((mean - whole) + fma(n, p, -mean)) + offset
    large = whole + np.floor(x)
    decided = (abs(x - np.rint(x)) > error) & (large >= 0.0) & (large <= n)
    large = large if decided else UNDECIDED
    k = small if is_small else large
    k = n - k if flipped & (k != UNDECIDED) else k
    return k if valid else np.nan


@njit_internal
def _probability(k, n, p):
    if k == 0.0:
        return exp(n * log1p(-p))
    if k == n:
        return exp(-deviance(n, n * p) - n * (1.0 - p))
    q = 1.0 - p
    exponent = stirling_error(n) - stirling_error(k) - stirling_error(n - k)
    exponent -= deviance(k, n * p) + deviance(n - k, n * q)
    return exp(exponent) * np.sqrt(n / (TWO_PI * k * (n - k)))


@njit_internal
def _reached(k, z, n, p):
    """Whether P(N <= k) >= Φ(z), for k < n."""
    term, total, odds = 1.0, 0.0, p / (1.0 - p)
    if z > 0.0:
        k += 1.0
        first = _probability(k, n, p)
        while total + term > total:
            total += term
            term *= (n - k) / (k + 1.0) * odds
            k += 1.0
        return first * total <= tail(z)
    first = _probability(k, n, p)
    while total + term > total:
        total += term
        term *= k / ((n - k + 1.0) * odds)
        k -= 1.0
    return first * total >= tail(-z)


_search = smallest_reached(_reached)


@njit_internal
def exact_binomial(z, n, p):
    """The quantile for valid parameters."""
    z, p, flipped = _rarer(limited(z), p)
    mean = n * p
    if mean == 0.0:
        k = 0.0
    elif mean >= _LARGE:
        whole, rest = np.floor(mean), fma(n, p, -mean)
        offset = series(z, np.sqrt(mean * (1.0 - p)), 1.0 - 2.0 * p)
        k = whole + np.floor(((mean - whole) + rest) + offset)
        k = min(max(k, 0.0), n)
    else:
        k = _search(mean + z * np.sqrt(mean * (1.0 - p)), n, z, n, p)
    return n - k if flipped else k


@njit_internal
def binomial_quantile(z, n, p):
    """The quantile; NaN for z or parameters that are invalid."""
    k = fast_binomial(z, n, p)
    return exact_binomial(z, n, p) if k == UNDECIDED else k


@inlined
def bernoulli_quantile(z, p):
    """1 with probability p, else 0; NaN for z or p that is invalid."""
    z = limited(z)
    q = tail(abs(z))  # compared with the smaller probability, for digits in both tails
    one = q < p if z > 0.0 else 1.0 - p < q
    k = 1.0 if one | (p == 1.0) else 0.0
    return k if (p >= 0.0) & (p <= 1.0) & (z == z) else np.nan
