"""exp and log restricted to the domains that the filters need, for speed.

Like the functions of `exponential`, which hold for all numbers, these have no branches and no
calls, so that loops vectorise. They are separate on purpose: without special cases and compensated
sums, exp and log take two thirds of the time. Inside the domains the relative error is below 1e-15.
The polynomial of log is fdlibm's (Sun Microsystems, 1993).
"""

import math

from ..native.jit import inline_always
from .exponential import (
    EXPONENT_BITS,
    LN2_HIGH,
    LN2_LOW,
    LOG,
    LOG2_E,
    MANTISSA,
    ONE_OVER_SQRT_HALF,
    SQRT_HALF,
    TWO_52,
    TWO_52_BIASED,
)
from .intrinsics import ROUND, bits_of, float_of, polynomial

_EXP = tuple(1.0 / math.factorial(i) for i in range(12, -1, -1))  # Taylor: truncation 2e-16

EXP_LOWEST = -708.0


@inline_always
def exp(x):
    """exp(x) for x <= 0; below -708, and for NaN, about 3e-308."""
    x = x if x > EXP_LOWEST else EXP_LOWEST
    shifted = x * LOG2_E + ROUND
    k = shifted - ROUND
    r = (x - k * LN2_HIGH) - k * LN2_LOW  # |r| <= ln(2) / 2
    return float_of(bits_of(polynomial(r, _EXP)) + (bits_of(shifted) << EXPONENT_BITS))


@inline_always
def log(x):
    """log(x) for positive, normal, finite x."""
    bits = bits_of(x) + ONE_OVER_SQRT_HALF
    k = float_of((bits >> EXPONENT_BITS) | TWO_52) - TWO_52_BIASED
    f = float_of((bits & MANTISSA) + SQRT_HALF) - 1.0  # x = 2**k (1 + f), |f| < 0.42
    s = f / (2.0 + f)
    z = s * s
    half_square = 0.5 * f * f
    tail = s * (half_square + polynomial(z, LOG) * z) + k * LN2_LOW
    return k * LN2_HIGH - ((half_square - tail) - f)
