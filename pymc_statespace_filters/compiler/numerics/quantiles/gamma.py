"""The gamma quantile at Φ(z), for every shape, to a relative error of 1e-9.

Three fast forms of y = log(x) have no branches.

* Shapes a below 8: with ρ = -log(Φ(z)) / a, the quantile of shape 1 at exp(-ρ) is
  x_1 = -log(1 - exp(-ρ)), and y - log(x_1) is a bounded, smooth function of a and x_1, down to
  a = 0 and x_1 = 0. It is a polynomial in a rational function of each, for a < 2 and for a >= 2.
* Larger shapes: the series y = log(a) + Σ L_j(s) / a**j with s = z / sqrt(a). It follows from the
  differential equation of the quantile, order by order in exact fractions; it is Temme's uniform
  expansion (1992, Math. Comp. 58) for the logarithm.

Normals so far out that these do not hold (beyond 4.5 for shapes below 8) take Newton's steps on the
logarithm of the smaller tail. With it as a concave function of y, they converge from everywhere.
"""

import math
from typing import Any

import numpy as np

from ...native.jit import inlined, njit_internal
from ..exponential import (
    EXPONENT_BITS,
    LN2_HIGH,
    LN2_LOW,
    LOG,
    MANTISSA,
    ONE_OVER_SQRT_HALF,
    SQRT_HALF,
    TWO_52,
    TWO_52_BIASED,
    exp,
    log,
    log1p,
)
from ..intrinsics import bits_of, float_of, fma, polynomial, sqrt
from ..restricted_domain import exp as normal_exp
from ..restricted_domain import log as normal_log
from .gamma_tables import LARGE, MEDIUM, SMALL, Fit
from .normal import limited, tail
from .series import deviance, in_variables, stirling_error

_LOG_SQRT_2PI = 0.5 * math.log(2.0 * math.pi)
# As `normal._RATIO`, in t = (x - 4) / (x + 4), to 1.3e-12
_RATIO = (
    2.3603940021200563e-07, 3.0017986947938135e-07, -2.1405260871456545e-06,
    -3.2101140133399333e-06, 1.3222226897259902e-05, 2.1031487012502963e-05,
    -8.764901859261692e-05, -9.431188918528127e-05, 0.0006948376139524403,
    -0.00028565901355743486, -0.005002369297093855, 0.017936103227266523, -0.03219783808499743,
    0.02860036364176472, 0.013999634738051724, -0.09670347731793671, 0.47205320650984467,
)  # fmt: skip
_STIRLING_FROM = 17.0  # `stirling_error` reads a table below
_MOST_STEPS = 100
# (log Γ(1 + a) + log(1 + a)) / a: 1 - Euler's constant, then (-1)**k (ζ(k) - 1) / k
_LOG_GAMMA = (
    2.4836745438024785e-09, -5.183475041970047e-09, 1.0838659214896955e-08,
    -2.2711094608943164e-08, 4.7698101693639804e-08, -1.0043224823968099e-07,
    2.1207184805554665e-07, -4.492469198764566e-07, 9.55141213040742e-07, -2.039215753801366e-06,
    4.374866789907488e-06, -9.439488275268397e-06, 2.050721277567069e-05, -4.492623673813314e-05,
    9.945751278180853e-05, -0.00022315475845357939, 0.0005096695247430425, -0.001192753911703261,
    0.0028905103307415234, -0.007385551028673986, 0.020580808427784546, -0.0673523010531981,
    0.3224670334241132, 0.42278433509846713,
)  # fmt: skip
_MEDIUM_FROM, _LARGE_FROM = 2.0, 8.0
_FARTHEST, _STEEPEST = 4.5, 1.61  # of the fast forms: |z| for shapes below 8, |s| above
_UNDECIDED = np.inf

_first_order, _orders = in_variables(LARGE[0], 1), in_variables(LARGE[1:], 2)


@inlined
def _large(z, a):
    """log(x), or `_UNDECIDED`, for a >= 8."""
    s, inverse = z / sqrt(a), 1.0 / a
    y = normal_log(a) + (s * _first_order(s) + inverse * _orders(inverse, s))
    return y if abs(s) < _STEEPEST else _UNDECIDED


@inlined
def _tail(x):
    """Φ(-x) for 0 <= x <= 37, to 2e-12."""
    one, four = x + 1.0, x + 4.0
    inverse = 1.0 / (one * four)
    ratio = polynomial((x - 4.0) * one * inverse, _RATIO)
    return normal_exp(-0.5 * x * x) * ratio * (four * inverse)


@inlined
def _exp(y):
    """exp(y) for y < 709; 0 where it would not be a normal number."""
    return normal_exp(y) if y > -708.0 else 0.0


@inlined
def _exponential_quantile(e):
    """-log(1 - e) for 0 < e < 1."""
    bits = bits_of(1.0 - e) + ONE_OVER_SQRT_HALF
    k = float_of((bits >> EXPONENT_BITS) | TWO_52) - TWO_52_BIASED
    # 1 - e = 2**k (1 + f)
    f = -e if k == 0.0 else float_of((bits & MANTISSA) + SQRT_HALF) - 1.0
    s = f / (2.0 + f)
    z = s * s
    half_square = 0.5 * f * f
    tail = fma(s, fma(polynomial(z, LOG), z, half_square), k * LN2_LOW)
    return (half_square - tail) - f - k * LN2_HIGH


def _fitted(fit: Fit) -> Any:
    """log(x), or `_UNDECIDED`, for shapes in the interval of a fit."""
    centre, width, kappa, top, rows = fit
    correction = in_variables(rows, 2)
    slope, offset = 2.0 / (1.0 + top), (1.0 - top) / (1.0 + top)

    @inlined
    def log_quantile(z, a):
        p = _tail(abs(z))
        more = 1.0 + a + centre
        inverse = 1.0 / (a * more)
        rho = -normal_log(p if z <= 0.0 else 1.0 - p) * (more * inverse)
        x1 = _exponential_quantile(normal_exp(-rho))
        y1 = -rho if rho > 40.0 else normal_log(x1)
        s = (1.0 + a - centre) * (a * inverse) * (1.0 / width)
        r = (x1 - kappa) / (x1 + kappa) * slope + offset
        y = y1 + correction(s, r)
        return y if abs(z) < _FARTHEST else _UNDECIDED

    return log_quantile


_small, _medium = _fitted(SMALL), _fitted(MEDIUM)


@inlined
def _valid(z, shape, scale):
    return (shape > 0.0) & (shape < np.inf) & (scale >= 0.0) & (scale < np.inf) & (z == z)


@njit_internal
def log_gamma_of_one_plus(a):
    """log Γ(1 + a) for a >= 0."""
    if a < 0.5:
        return a * polynomial(a, _LOG_GAMMA) - log1p(a)
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
    if not _valid(z, shape, scale):
        return np.nan
    z = limited(z)
    if shape < _MEDIUM_FROM:
        y = _small(z, shape)
    elif shape < _LARGE_FROM:
        y = _medium(z, shape)
    else:
        y = _large(z, shape)
    return scale * _exp(exact_log_gamma(z, shape) if y == _UNDECIDED else y)


@njit_internal
def gamma_block(buffer, z, shape, scale, out, size):
    """The quantiles of the rows ``z``, ``shape`` and ``scale`` of a buffer, into row ``out``."""
    n_small = n_large = 0
    for j in range(size):
        n_small += buffer[shape, np.uint64(j)] < _MEDIUM_FROM
        n_large += buffer[shape, np.uint64(j)] >= _LARGE_FROM
    if n_large > 0:
        for j in range(size):
            i = np.uint64(j)
            a = buffer[shape, i]
            buffer[out, i] = _large(limited(buffer[z, i]), a if a > _LARGE_FROM else _LARGE_FROM)
    if n_small > 0:
        for j in range(size):
            i = np.uint64(j)
            a, other = buffer[shape, i], buffer[out, i]
            y = _small(limited(buffer[z, i]), a if a < _MEDIUM_FROM else 1.0)
            buffer[out, i] = y if a < _MEDIUM_FROM else other
    if n_small + n_large < size:
        for j in range(size):
            i = np.uint64(j)
            a, other = buffer[shape, i], buffer[out, i]
            is_medium = (a >= _MEDIUM_FROM) & (a < _LARGE_FROM)
            y = _medium(limited(buffer[z, i]), a if is_medium else _MEDIUM_FROM)
            buffer[out, i] = y if is_medium else other
    n_undecided = 0
    for j in range(size):
        n_undecided += buffer[out, np.uint64(j)] == _UNDECIDED
    if n_undecided > 0:
        for j in range(size):
            i = np.uint64(j)
            if buffer[out, i] == _UNDECIDED and _valid(buffer[z, i], buffer[shape, i], 0.0):
                buffer[out, i] = exact_log_gamma(buffer[z, i], buffer[shape, i])
    for j in range(size):
        i = np.uint64(j)
        s, is_valid = buffer[scale, i], _valid(buffer[z, i], buffer[shape, i], buffer[scale, i])
        x = s * _exp(buffer[out, i])
        buffer[out, i] = x if is_valid else np.nan
