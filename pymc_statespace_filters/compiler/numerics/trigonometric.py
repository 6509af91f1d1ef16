"""Trigonometric functions and division with remainder, for vector code.

The rules are those of `exponential`: selects for branches, no calls, the domains of NumPy, and the
largest error found in each docstring. The polynomials of sine and cosine are fdlibm's (Sun
Microsystems, 1993); that of the arctangent is a Chebyshev interpolant.

Angles are reduced by pi / 2 in three parts, which with fused multiplications is accurate below
2**47, where neighbouring numbers are 1/64 apart. Larger angles are replaced by zero.
"""

import numpy as np

from ..native.jit import inlined
from .intrinsics import ROUND, bits_of, float_of, fma, polynomial, sign_bit, with_sign

_TWO_OVER_PI = 0.6366197723675814
_HALF_PI, _HALF_PI_2 = 1.5707963267948966, 6.123233995736766e-17
_HALF_PI_3 = -1.4973849048591698e-33
_QUARTER_PI, _QUARTER_PI_2 = 0.7853981633974483, 3.061616997868383e-17
_PI, _PI_2 = 2.0 * _HALF_PI, 2.0 * _HALF_PI_2
_LARGEST_ANGLE = 2.0**47
_TAN_EIGHTH, _TAN_THREE_EIGHTHS = 0.41421356237309503, 2.414213562373095  # of pi

_LARGE = 1e300
_NO_BITS, _ONE_BIT, _TWO_BIT, _TO_SIGN = (np.uint64(bits) for bits in (0, 1, 2, 62))

# (sin(a) / a - 1) / z and (cos(a) - 1 + z / 2) / z**2 for z = a**2 <= (pi / 4)**2
SIN = (
    1.58969099521155010221e-10, -2.50507602534068634195e-08, 2.75573137070700676789e-06,
    -1.98412698298579493134e-04, 8.33333333332248946124e-03, -1.66666666666666324348e-01,
)  # fmt: skip
COS = (
    -1.13596475577881948265e-11, 2.08757232129817482790e-09, -2.75573143513906633035e-07,
    2.48015872894767294178e-05, -1.38888888888741095749e-03, 4.16666666666666019037e-02,
)  # fmt: skip
# (arctan(v) / v - 1) / z for z = v**2 <= tan(pi / 8)**2
_ARCTAN = (
    0.01628357235648259, -0.0345685906686069, 0.045515165635903104, -0.052304374642516874,
    0.05878926715756726, -0.066664246872465, 0.07692296363979952, -0.09090908753118594,
    0.11111111105147764, -0.14285714285659748, 0.19999999999999804, -0.3333333333333333,
)  # fmt: skip


@inlined
def _quarter(x):
    """(a, bits): x = a + n pi / 2 with |a| <= pi / 4; the lowest two bits are n modulo 4."""
    x = x if abs(x) < _LARGEST_ANGLE else x * 0.0
    shifted = fma(x, _TWO_OVER_PI, ROUND)
    n = shifted - ROUND
    a = fma(-n, _HALF_PI_3, fma(-n, _HALF_PI_2, fma(-n, _HALF_PI, x)))
    return a, bits_of(shifted)


@inlined
def _sin_parts(a):
    z = a * a
    return a, a * z * polynomial(z, SIN)


@inlined
def _cos_parts(a):
    z = a * a
    half = 0.5 * z
    high = 1.0 - half
    return high, fma(z * z, polynomial(z, COS), (1.0 - high) - half)


@inlined
def _sin_cos_near_zero(a):
    """(sin(a), cos(a)) for |a| <= pi / 4."""
    s, s_low = _sin_parts(a)
    c, c_low = _cos_parts(a)
    return s + s_low, c + c_low


@inlined
def _turned(value, bits):
    """``value``, negated if the second bit is set."""
    return float_of(bits_of(value) ^ ((bits & _TWO_BIT) << _TO_SIGN))


@inlined
def sin(x):
    """The sine, to 1.5 ulp; of an angle from 2**47 on, 0."""
    a, bits = _quarter(x)
    s, c = _sin_cos_near_zero(a)
    result = _turned(s if (bits & _ONE_BIT) == 0 else c, bits)
    return x if x == 0.0 else result


@inlined
def cos(x):
    """The cosine, to 1.5 ulp; of an angle from 2**47 on, 1."""
    a, bits = _quarter(x)
    s, c = _sin_cos_near_zero(a)
    # cos(x) = sin(x + pi / 2)
    return _turned(c if (bits & _ONE_BIT) == 0 else s, bits + _ONE_BIT)


@inlined
def tan(x):
    """The tangent, to 2.1 ulp; of an angle from 2**47 on, 0."""
    a, bits = _quarter(x)
    s, s_low = _sin_parts(a)
    c, c_low = _cos_parts(a)
    even = (bits & _ONE_BIT) == 0
    top, top_low = (s if even else -c), (s_low if even else -c_low)
    bottom, bottom_low = (c if even else s), (c_low if even else s_low)
    inverse = 1.0 / (bottom + bottom_low)
    quotient = (top + top_low) * inverse
    remainder = fma(-quotient, bottom, top) + fma(-quotient, bottom_low, top_low)
    return x if x == 0.0 else fma(remainder, inverse, quotient)


@inlined
def _arctan_of_ratio(y, x):
    """(high, low), whose sum is arctan(y / x), for y and x not negative."""
    middle, far = y > _TAN_EIGHTH * x, y > _TAN_THREE_EIGHTHS * x
    below, above = y - x, y + x
    top = -x if far else (below if middle else y)
    bottom = y if far else (above if middle else x)
    base = _HALF_PI if far else (_QUARTER_PI if middle else 0.0)
    base_low = _HALF_PI_2 if far else (_QUARTER_PI_2 if middle else 0.0)
    v = top / bottom
    z = v * v
    high = base + v
    return high, fma(v * z, polynomial(z, _ARCTAN), base_low) + ((base - high) + v)


@inlined
def arctan(x):
    """The arctangent, to 1.7 ulp."""
    high, low = _arctan_of_ratio(abs(x), 1.0)
    return with_sign(high + low, sign_bit(x))


@inlined
def arctan2(y, x):
    """The angle of the point (x, y), to 2.0 ulp."""
    width, height = abs(x), abs(y)
    scale = 0.125 if (width > _LARGE) | (height > _LARGE) else 1.0
    diagonal = (width == np.inf) & (height == np.inf)
    across = scale * (1.0 if diagonal else width)
    up = scale * (1.0 if diagonal else height)
    high, low = _arctan_of_ratio(up, 1.0 if (across == 0.0) & (up == 0.0) else across)
    left = _PI - high
    left_low = ((_PI - left) - high) + (_PI_2 - low)
    behind = sign_bit(x) != _NO_BITS
    return with_sign(left + left_low if behind else high + low, sign_bit(y))


# ---- division with a remainder


@inlined
def _floor_division(x, y):
    """(q, r) with x = q y + r, q whole and r between 0 and y, for |x / y| < 2**52."""
    q = np.floor(x / y)
    r = x if q == 0.0 else fma(-q, y, x)
    # Rounding may have raised x / y to a whole number.
    carried = (r != 0.0) & ((r < 0.0) != (y < 0.0))
    lower, rest = q - 1.0, r + y
    return lower if carried else q, rest if carried else r


@inlined
def floor_divide(x, y):
    """The largest whole number not above x / y, for |x / y| < 2**52."""
    return _floor_division(x, y)[0]


@inlined
def modulo(x, y):
    """The remainder of `floor_divide`, with the sign of y."""
    return _floor_division(x, y)[1]
