"""Exponentials, logarithms, powers and hyperbolic functions for vector code.

Branches are selects and nothing is called, so that loops over members vectorise; functions of libm
would be called number by number. Domains are those of NumPy, with its NaN, infinities, signed zeros
and subnormal numbers. Each docstring states the largest error found, in units in the last place
(ulp) of the result.

The polynomials are Chebyshev interpolants, computed for these intervals with 200 bits and rounded;
that of `_log_parts` and its evaluation are fdlibm's (Sun Microsystems, 1993).
"""

import numpy as np

from ..native.jit import inlined
from .intrinsics import ROUND, bits_of, float_of, fma, polynomial, power_of_two, sign_bit, with_sign

LOG2_E, _LOG2_E_LOW = 1.4426950408889634, 2.0355273740931033e-17
_LOG10_E, _LOG10_E_LOW = 0.4342944819032518, 1.098319650216765e-17
_LN2, _LN2_REST = 0.6931471805599453, 2.3190468138462996e-17
# The high part is short enough that its product with an exponent is exact.
LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_LOG10_2_HIGH, _LOG10_2_LOW = 0.301029995663157, 8.241712586023572e-13
_THIRD, _THIRD_LOW = 0.3333333333333333, 1.850371707708594e-17

_SMALLEST_NORMAL = 2.2250738585072014e-308
_TWO_54 = 2.0**54
_TINY = 2.0**-54  # below it, expm1(x) and log1p(x) round to x
_BEYOND = 1000.0  # exp(1000) overflows, exp(-1000) underflows
MANTISSA = np.uint64(0x000FFFFFFFFFFFFF)
EXPONENT_BITS = np.uint64(52)
SQRT_HALF = np.uint64(0x3FE6A09E667F3BCD)
ONE_OVER_SQRT_HALF = np.uint64(0x3FF0000000000000 - 0x3FE6A09E667F3BCD)
TWO_52 = np.uint64(0x4330000000000000)  # the bits of 2.0**52: or-ing an integer in adds it
TWO_52_BIASED = 4503599627370496.0 + 1023.0

# (exp(r) - 1 - r) / r**2 for |r| <= ln(2) / 2
_EXP = (
    2.091489357888792e-09, 2.5105506332430665e-08, 2.755727314533403e-07, 2.7557254703146334e-06,
    2.480158732594125e-05, 0.00019841269875371672, 0.0013888888888883635, 0.008333333333325976,
    0.04166666666666667, 0.1666666666666667, 0.5,
)  # fmt: skip
# (log(1 + f) - f + f**2 / 2) in z = (f / (2 + f))**2: fdlibm's, without its factor z
LOG = (
    1.479819860511658591e-01, 1.531383769920937332e-01, 1.818357216161805012e-01,
    2.222219843214978396e-01, 2.857142874366239149e-01, 3.999999999940941908e-01,
    6.666666666666735130e-01,
)  # fmt: skip
# (arctanh(s) / s - 1 - z / 3) / z**2 for z = s**2 <= 0.0296
_ARCTANH = (
    0.05865053930946515, 0.05852785947838605, 0.06667414786953267, 0.07692297251904945,
    0.09090909169848817, 0.11111111110818422, 0.14285714285714698, 0.2,
)  # fmt: skip


# ---- exponentials: x = k ln(2) + r, exp(x) = 2**k exp(r)


@inlined
def _halved(x):
    """(k, r) with x = k ln(2) + r, |r| <= ln(2) / 2."""
    k = fma(x, LOG2_E, ROUND) - ROUND
    return k, fma(-k, _LN2_REST, fma(-k, _LN2, x))


@inlined
def _exp_near_zero(r, low):
    """exp(r + low), where ``low`` is below the rounding of r."""
    y = 1.0 + r
    lost = (1.0 - y) + r
    return y + fma(r * r, polynomial(r, _EXP), lost + low)


@inlined
def _scaled(y, k):
    """2**k y, rounded once, in two factors: only the second may overflow or underflow."""
    first = (0.5 * k + ROUND) - ROUND
    return y * power_of_two(first) * power_of_two(k - first)


@inlined
def exp_times(x, doublings):
    """exp(x) 2**doublings, for a small whole number of doublings."""
    x = _BEYOND if x > _BEYOND else x
    x = -_BEYOND if x < -_BEYOND else x
    k, r = _halved(x)
    return _scaled(_exp_near_zero(r, 0.0), k + doublings)


@inlined
def exp(x):
    """exp(x), to 1.3 ulp."""
    return exp_times(x, 0.0)


@inlined
def exp2(x):
    """2**x, to 1.1 ulp."""
    x = 1100.0 if x > 1100.0 else x
    x = -1100.0 if x < -1100.0 else x
    k = (x + ROUND) - ROUND
    s = x - k
    r = s * _LN2
    low = fma(s, _LN2_REST, fma(s, _LN2, -r))
    return _scaled(_exp_near_zero(r, low), k)


@inlined
def expm1(x):
    """exp(x) - 1, to 1.8 ulp."""
    y = 709.9 if x > 709.9 else x
    y = -40.0 if y < -40.0 else y
    k, r = _halved(y)
    half = power_of_two(k - 1.0)
    result = 2.0 * fma(half, fma(r * r, polynomial(r, _EXP), r), half - 0.5)
    return x if abs(x) < _TINY else result


# ---- logarithms: x = 2**k (1 + f), |f| < 0.42


@inlined
def _split(x):
    """(k, f) of a positive finite x, which may be subnormal."""
    tiny = x < _SMALLEST_NORMAL
    enlarged = x * _TWO_54
    bits = bits_of(enlarged if tiny else x) + ONE_OVER_SQRT_HALF
    k = float_of((bits >> EXPONENT_BITS) | TWO_52) - TWO_52_BIASED
    f = float_of((bits & MANTISSA) + SQRT_HALF) - 1.0
    lower = k - 54.0
    return lower if tiny else k, f


@inlined
def _log_parts(f):
    """(high, low), whose sum is log(1 + f) to some 60 bits."""
    s = f / (2.0 + f)
    z = s * s
    half_square = 0.5 * f * f
    high = f - half_square
    low = ((f - high) - half_square) + s * (half_square + z * polynomial(z, LOG))
    return high, low


@inlined
def _sum(large, small, rest):
    """large + small + rest, where |large| >= |small| or large is zero, rounded about once."""
    total = large + small
    return total + (((large - total) + small) + rest)


@inlined
def _log_domain(x, result):
    """A logarithm at any x, given the ``result`` for positive finite x."""
    result = result if x < np.inf else x
    outside = -np.inf if x == 0.0 else np.nan
    return result if x > 0.0 else (x if x != x else outside)


@inlined
def log(x):
    """The natural logarithm, to 0.7 ulp."""
    k, f = _split(x)
    high, low = _log_parts(f)
    return _log_domain(x, _sum(k * LN2_HIGH, high, fma(k, LN2_LOW, low)))


@inlined
def log1p(x):
    """log(1 + x), to 0.7 ulp."""
    y = 1.0 + x
    rounded_x = y - 1.0
    lost = (1.0 - (y - rounded_x)) + (x - rounded_x)
    k, f = _split(y)
    high, low = _log_parts(f)
    result = _sum(k * LN2_HIGH, high, fma(k, LN2_LOW, low) + lost / y)
    return x if abs(x) < _TINY else _log_domain(y, result)


@inlined
def _log_in_base(x, step, step_low, unit, unit_low):
    """k step + log(1 + f) unit."""
    k, f = _split(x)
    high, low = _log_parts(f)
    product = high * unit
    rest = fma(high, unit, -product) + fma(high, unit_low, low * unit)
    return _log_domain(x, _sum(k * step, product, fma(k, step_low, rest)))


@inlined
def log2(x):
    """The logarithm to base 2, to 0.7 ulp."""
    return _log_in_base(x, 1.0, 0.0, LOG2_E, _LOG2_E_LOW)


@inlined
def log10(x):
    """The logarithm to base 10, to 0.7 ulp."""
    return _log_in_base(x, _LOG10_2_HIGH, _LOG10_2_LOW, _LOG10_E, _LOG10_E_LOW)


# ---- powers


@inlined
def _long_log(x):
    """(high, low), whose sum is log(x) to some 64 bits, for positive finite x."""
    k, f = _split(x)
    # s = f / (2 + f) and z = s**2, as sums of two numbers
    divisor = 2.0 + f
    divisor_low = f - (divisor - 2.0)
    inverse = 1.0 / divisor
    s = f * inverse
    s_low = (fma(-s, divisor, f) - s * divisor_low) * inverse
    z = s * s
    z_low = fma(s, s, -z) + 2.0 * s * s_low
    # arctanh(s) = s + s (z / 3 + z**2 p)
    tail = fma(z, polynomial(z, _ARCTANH), _THIRD_LOW)
    factor = _THIRD + tail
    factor_low = (_THIRD - factor) + tail
    w = z * factor
    w_low = fma(z, factor, -w) + fma(z, factor_low, z_low * factor)
    t = s * w
    t_low = fma(s, w, -t) + fma(s, w_low, s_low * w)
    half = s + t
    half_low = ((s - half) + t) + (t_low + s_low)
    # log(x) = k ln(2) + 2 arctanh(s)
    steps = k * LN2_HIGH
    total = steps + 2.0 * half
    total_low = ((steps - total) + 2.0 * half) + fma(k, LN2_LOW, 2.0 * half_low)
    high = total + total_low
    return high, (total - high) + total_low


@inlined
def power(x, y):
    """x**y, to 1.1 ulp."""
    magnitude = abs(x)
    high, low = _long_log(magnitude)
    high = high if magnitude < np.inf else magnitude
    high = high if magnitude > 0.0 else (-np.inf if magnitude == 0.0 else magnitude)
    # exp(y log(x))
    exponent = y * high
    rest = fma(y, high, -exponent) + y * low
    rest = rest if abs(exponent) < _BEYOND else 0.0
    exponent = _BEYOND if exponent > _BEYOND else exponent
    exponent = -_BEYOND if exponent < -_BEYOND else exponent
    k = fma(exponent, LOG2_E, ROUND) - ROUND
    long_r, long_rest = fma(-k, _LN2, exponent), fma(-k, _LN2_REST, rest)
    r = long_r + long_rest
    r_low = (long_r - r) + long_rest
    result = _scaled(_exp_near_zero(r, r_low), k)
    # negative x
    whole = np.floor(y) == y
    even = 2.0 * np.floor(0.5 * y) == y
    undefined = (x < 0.0) & (magnitude < np.inf) & (not whole)
    result = np.nan if undefined else result
    signed = float_of(bits_of(result) | sign_bit(x))
    result = signed if whole & (not even) else result
    # 1**y, x**0 and (-1)**(+-inf) are 1
    one = (x == 1.0) | (y == 0.0) | ((x == -1.0) & (abs(y) == np.inf))
    return 1.0 if one else result


# (tanh(x) / x - 1) / z for z = x**2 <= 0.55**2
_TANH = (
    -2.0598556673275166e-05, 8.510707927354112e-05, -0.00023463104528300406,
    0.0005889348072447028, -0.0014556615775702365, 0.003592110347096177, -0.008863234395418095,
    0.021869488493563037, -0.05396825396743174, 0.13333333333332714, -0.3333333333333333,
)  # fmt: skip
_TANH_POLYNOMIAL_TO = 0.55
# (sinh(x) / x - 1) / z for z = x**2 <= 1
_SINH = (
    7.746178593018827e-13, 1.6057679623801638e-10, 2.5052117695907823e-08, 2.7557319191381816e-06,
    0.00019841269841324198, 0.008333333333333299, 0.16666666666666666,
)  # fmt: skip


@inlined
def sinh(x):
    """The hyperbolic sine, to 1.7 ulp."""
    magnitude = abs(x)
    z = magnitude * magnitude
    near = fma(magnitude * z, polynomial(z, _SINH), magnitude)
    half = exp_times(magnitude, -1.0)
    far = half - 0.25 / half
    return with_sign(near if magnitude < 1.0 else far, sign_bit(x))


@inlined
def cosh(x):
    """The hyperbolic cosine, to 1.2 ulp."""
    half = exp_times(abs(x), -1.0)
    return half + 0.25 / half


@inlined
def tanh(x):
    """The hyperbolic tangent, to 1.6 ulp."""
    magnitude = abs(x)
    z = magnitude * magnitude
    near = fma(magnitude * z, polynomial(z, _TANH), magnitude)
    far = 1.0 - 2.0 / (exp(2.0 * magnitude) + 1.0)
    return with_sign(near if magnitude < _TANH_POLYNOMIAL_TO else far, sign_bit(x))
