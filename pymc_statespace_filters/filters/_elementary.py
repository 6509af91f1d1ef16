"""exp, log, sin and cos without branches or library calls, so that loops become vector code.

The polynomials of log, sin and cos are those of fdlibm (Sun Microsystems, 1993). Domains are what
the filters need, no more; inside them the relative error is below 1e-15.
"""

import numpy as np

from pymc_statespace_filters.filters._compile import pasted

_LN2_HIGH = 6.93147180369123816490e-01  # 32 bits, so that its product with a small integer is exact
_LN2_LOW = 1.90821492927058770002e-10
_LOG2_E = 1.4426950408889634
_HALF_PI = 1.5707963267948966

_ROUND = 6755399441055744.0  # 1.5 * 2**52: adding it rounds to an integer, held in the lowest bits
_MANTISSA = np.uint64(0x000FFFFFFFFFFFFF)
_EXPONENT_BITS = np.uint64(52)
_SQRT_HALF = np.uint64(0x3FE6A09E667F3BCD)
_ONE_OVER_SQRT_HALF = np.uint64(0x3FF0000000000000 - 0x3FE6A09E667F3BCD)
_TWO_52 = np.uint64(0x4330000000000000)  # the bits of 2.0**52: or-ing an integer in adds it
_TWO_52_BIASED = 4503599627370496.0 + 1023.0

EXP_LOWEST = -708.0


@pasted
def bits_of(x):
    """The 64 bits of a float64, as uint64."""
    return np.float64(x).view(np.uint64)


@pasted
def float_of(bits):
    """The float64 with these 64 bits."""
    return np.uint64(bits).view(np.float64)


@pasted
def exp(x):
    """exp(x) for x <= 0; below -708, and for NaN, about 3e-308."""
    x = x if x > EXP_LOWEST else EXP_LOWEST
    shifted = x * _LOG2_E + _ROUND
    k = shifted - _ROUND
    r = (x - k * _LN2_HIGH) - k * _LN2_LOW  # |r| <= ln(2) / 2
    p = 1.0 / 479001600.0  # Taylor to r**12: truncation 2e-16
    p = p * r + 1.0 / 39916800.0
    p = p * r + 1.0 / 3628800.0
    p = p * r + 1.0 / 362880.0
    p = p * r + 1.0 / 40320.0
    p = p * r + 1.0 / 5040.0
    p = p * r + 1.0 / 720.0
    p = p * r + 1.0 / 120.0
    p = p * r + 1.0 / 24.0
    p = p * r + 1.0 / 6.0
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    return float_of(bits_of(p) + (bits_of(shifted) << _EXPONENT_BITS))


@pasted
def log(x):
    """log(x) for positive, normal, finite x."""
    bits = bits_of(x) + _ONE_OVER_SQRT_HALF
    k = float_of((bits >> _EXPONENT_BITS) | _TWO_52) - _TWO_52_BIASED
    f = float_of((bits & _MANTISSA) + _SQRT_HALF) - 1.0  # x = 2**k (1 + f), |f| < 0.42
    s = f / (2.0 + f)
    z = s * s
    p = 1.479819860511658591e-01
    p = p * z + 1.531383769920937332e-01
    p = p * z + 1.818357216161805012e-01
    p = p * z + 2.222219843214978396e-01
    p = p * z + 2.857142874366239149e-01
    p = p * z + 3.999999999940941908e-01
    p = p * z + 6.666666666666735130e-01
    half_square = 0.5 * f * f
    tail = s * (half_square + p * z) + k * _LN2_LOW
    return k * _LN2_HIGH - ((half_square - tail) - f)


@pasted
def sin_cos_quarter(v):
    """(sin(pi v / 2), cos(pi v / 2)) for |v| <= 1/2."""
    a = v * _HALF_PI
    z = a * a
    s = 1.58969099521155010221e-10
    s = s * z - 2.50507602534068634195e-08
    s = s * z + 2.75573137070700676789e-06
    s = s * z - 1.98412698298579493134e-04
    s = s * z + 8.33333333332248946124e-03
    s = s * z - 1.66666666666666324348e-01
    c = -1.13596475577881948265e-11
    c = c * z + 2.08757232129817482790e-09
    c = c * z - 2.75573143513906633035e-07
    c = c * z + 2.48015872894767294178e-05
    c = c * z - 1.38888888888741095749e-03
    c = c * z + 4.16666666666666019037e-02
    return a + a * z * s, 1.0 - (0.5 * z - z * z * c)
