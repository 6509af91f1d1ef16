"""The gamma quantile at Φ(z), for every shape."""

import math

import numpy as np

from pymc_statespace_filters.compiler.native.jit import njit_internal
from pymc_statespace_filters.compiler.numerics.exponential import exp, log, log1p
from pymc_statespace_filters.compiler.numerics.quantiles.normal import limited, tail
from pymc_statespace_filters.compiler.numerics.quantiles.saddle_point import (
    deviance,
    stirling_error,
)

_LOG_SQRT_2PI = 0.5 * math.log(2.0 * math.pi)
_STIRLING_FROM = 17.0  # `stirling_error` reads a table below
_MOST_STEPS = 100


@njit_internal
def log_gamma_of_one_plus(a):
    """log Γ(1 + a) for a >= 0."""
    product = 1.0
    while a < _STIRLING_FROM:
        a += 1.0
        product *= a
    return (a + 0.5) * log(a) - a + _LOG_SQRT_2PI + stirling_error(a) - log(product)


@njit_internal
def _log_term(a, y):
    """log(x**a exp(-x) / Γ(1 + a)) at x = exp(y)."""
    x = exp(y)
    if a < _STIRLING_FROM:
        return a * y - x - log_gamma_of_one_plus(a)
    return -stirling_error(a) - deviance(a, x) - 0.5 * log(a) - _LOG_SQRT_2PI


@njit_internal
def _lower(a, x):
    """P(a, x) by its series, without the factor x**a exp(-x) / Γ(1 + a)."""
    term, total, divisor = 1.0, 0.0, a
    while total + term > total:
        total += term
        divisor += 1.0
        term *= x / divisor
    return total


@njit_internal
def _upper(a, x):
    """Q(a, x) by its continued fraction, without that factor (Lentz's method)."""
    b = x + 1.0 - a
    c, d = 1e300, 1.0 / b
    fraction, i = d, 0.0
    while True:
        i += 1.0
        numerator = i * (a - i)
        b += 2.0
        d = 1.0 / (numerator * d + b)
        c = b + numerator / c
        fraction *= c * d
        if abs(c * d - 1.0) < 1e-16 or i > 1e7:
            return a * fraction


@njit_internal
def _step(y, log_probability, upwards, a):
    """Newton's step from log(x) = y to the quantile, on the logarithm of the probability.

    That is a concave function of y, so that the steps converge from everywhere.
    """
    x, log_term = exp(y), _log_term(a, y)
    if x > a + 1.0:
        q = exp(log_term) * _upper(a, x)
        p = 1.0 - q
    else:
        p = exp(log_term) * _lower(a, x)
        q = 1.0 - p
    if upwards:
        if x > a + 1.0:
            return (log_term + log(_upper(a, x)) - log_probability) * q / (a * exp(log_term))
        return (log1p(-p) - log_probability) * q / (a * exp(log_term))
    if x > a + 1.0:
        return (log_probability - log1p(-q)) * p / (a * exp(log_term))
    total = _lower(a, x)
    return (log_probability - log_term - log(total)) * total / a


@njit_internal
def exact_log_gamma(z, a):
    """The logarithm of the quantile for a valid shape and scale 1."""
    z = limited(z)
    upwards = z > 1.0
    log_probability = log(tail(abs(z))) if upwards or z <= 0.0 else log1p(-tail(z))
    if a < 1.0:
        # P(a, x) <= x**a / Γ(1 + a): below the quantile
        p = 1.0 - tail(z) if z > 0.0 else tail(-z)
        y = min((log(p) + log_gamma_of_one_plus(a)) / a, 6.0)
    else:
        cube = max(1.0 - 1.0 / (9.0 * a) + z / (3.0 * np.sqrt(a)), 0.02)
        y = log(a) + 3.0 * log(cube)
    for _ in range(_MOST_STEPS):
        step = _step(y, log_probability, upwards, a)
        y += min(max(step, -50.0), 5.0) if abs(y) < 700.0 else step
        if abs(step) < 1e-14 * max(abs(y), 1.0) or y < -745.0:
            break
    return y


@njit_internal
def gamma_quantile(z, shape, scale):
    """The quantile; NaN for z or parameters that are invalid."""
    if not (0.0 < shape < np.inf and 0.0 <= scale < np.inf and z == z):
        return np.nan
    return scale * exp(exact_log_gamma(z, shape))
