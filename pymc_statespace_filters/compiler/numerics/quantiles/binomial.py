"""The binomial quantile at Φ(z), exact for every number of trials and probability.

By the methods of `poisson`, for the rarer of success and failure.
"""

import numpy as np

from ...native.jit import inlined, njit_internal
from ..exponential import exp, log1p
from ..intrinsics import fma, polynomial, sqrt
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
from .single_precision import ONE, TWO

_LARGE = 1e6
# artanh(s) / s in s**2 for s <= 1/3: Taylor, truncation 1.4e-8
_ARTANH = tuple(np.float32(1.0 / i) for i in range(13, 0, -2))


@inlined
def _rarer(z, p):
    """(z, p) of the rarer outcome, and whether that is failure."""
    flipped = p > 0.5
    return -z if flipped else z, 1.0 - p if flipped else p, flipped


@inlined
def _valid(z, n, p):
    return (n >= 0.0) & (n < np.inf) & (np.floor(n) == n) & (p >= 0.0) & (p <= 1.0) & (z == z)


@inlined
def _large_binomial(z, n, p):
    """The quantile, or `UNDECIDED`, for n p >= 8 and p <= 1/2."""
    mean, q = n * p, 1.0 - p
    variance = mean * q
    offset, error = short_series(z, sqrt(4.0 if variance < 4.0 else variance), q - p)
    whole = np.floor(mean)
    x = ((mean - whole) + fma(n, p, -mean)) + offset
    k = whole + np.floor(x)
    return k if (abs(x - np.rint(x)) > error) & (k >= 0.0) & (k <= n) else UNDECIDED


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
    if not _valid(z, n, p):
        return np.nan
    rarer_z, rarer_p, flipped = _rarer(limited(z), p)
    if n * rarer_p < SMALL:
        odds = rarer_p / (1.0 - rarer_p)
        k = small_quantile(rarer_z, exp(n * log1p(-rarer_p)), n * odds, odds)
    else:
        k = _large_binomial(rarer_z, n, rarer_p)
    if k == UNDECIDED:
        return exact_binomial(z, n, p)
    return n - k if flipped else k


@njit_internal
def _small_block(buffer, z, n, p, out, size):
    work = rows()
    for j in range(size):
        i = np.uint64(j)
        rarer_z, rarer_p, _ = _rarer(buffer[z, i], buffer[p, i])
        mean = buffer[n, i] * rarer_p
        is_small = mean < SMALL
        mean, rarer_p = (
            np.float32(mean if is_small else 0.0),
            np.float32(rarer_p if is_small else 0.0),
        )
        q, two = ONE - rarer_p, TWO - rarer_p
        inverse = ONE / (q * two)
        s = rarer_p * (q * inverse)  # log(1 - p) = -2 artanh(s)
        log_first = -TWO * mean * (q * inverse) * polynomial(s * s, _ARTANH)
        two *= inverse
        start(work, i, np.float32(rarer_z), log_first, mean * two, rarer_p * two)
    add_upwards(work, size)
    for j in range(size):
        i = np.uint64(j)
        trials, other, k = buffer[n, i], buffer[out, i], found(work, i)
        _, rarer_p, flipped = _rarer(0.0, buffer[p, i])
        k = trials - k if flipped & (k != UNDECIDED) else k
        buffer[out, i] = k if trials * rarer_p < SMALL else other


@njit_internal
def _rare_block(buffer, z, n, p, out, size):
    for j in range(size):
        i = np.uint64(j)
        trials = buffer[n, i]
        rarer_z, rarer_p, flipped = _rarer(buffer[z, i], buffer[p, i])
        is_zero = is_surely_zero(np.float32(rarer_z), np.float32(trials * rarer_p))
        k = trials if flipped else 0.0
        buffer[out, i] = k if is_zero else UNDECIDED


@njit_internal
def binomial_block(buffer, z, n, p, out, size):
    """The quantiles of the rows ``z``, ``n`` and ``p`` of a buffer, into its row ``out``."""
    n_large = n_rare = n_undecided = 0
    for j in range(size):
        i = np.uint64(j)
        mean = buffer[n, i] * min(buffer[p, i], 1.0 - buffer[p, i])
        n_large += mean >= SMALL
        n_rare += mean < RARE
    if n_large > 0:
        for j in range(size):
            i = np.uint64(j)
            rarer_z, rarer_p, flipped = _rarer(limited(buffer[z, i]), buffer[p, i])
            k = _large_binomial(rarer_z, buffer[n, i], rarer_p)
            buffer[out, i] = buffer[n, i] - k if flipped & (k != UNDECIDED) else k
    if n_rare == size:
        _rare_block(buffer, z, n, p, out, size)
    elif n_large < size:
        _small_block(buffer, z, n, p, out, size)
    for j in range(size):
        i = np.uint64(j)
        k, is_valid = buffer[out, i], _valid(buffer[z, i], buffer[n, i], buffer[p, i])
        k = k if is_valid else np.nan
        n_undecided += k == UNDECIDED
        buffer[out, i] = k
    if n_undecided > 0:
        for j in range(size):
            i = np.uint64(j)
            if buffer[out, i] == UNDECIDED:
                buffer[out, i] = binomial_quantile(buffer[z, i], buffer[n, i], buffer[p, i])


@inlined
def bernoulli_quantile(z, p):
    """1 with probability p, else 0; NaN for z or p that is invalid."""
    z = limited(z)
    q = tail(abs(z))  # compared with the smaller probability, for digits in both tails
    one = q < p if z > 0.0 else 1.0 - p < q
    k = 1.0 if one | (p == 1.0) else 0.0
    return k if (p >= 0.0) & (p <= 1.0) & (z == z) else np.nan
