"""exp and the normal distribution function in single precision, for loops that vectorise.

A vector holds twice as many numbers as in double precision. Numba makes a result double if one
operand is, so constants have single precision too.
"""

import math

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from ...native.jit import inlined
from ..intrinsics import fma, polynomial

ZERO, HALF, ONE, TWO, THREE, FOUR = map(np.float32, (0.0, 0.5, 1.0, 2.0, 3.0, 4.0))
_ROUND = np.float32(1.5 * 2.0**23)  # adding it rounds to an integer, held in the lowest bits
_LOG2_E = np.float32(1.0 / math.log(2.0))
_LN2_HIGH = np.float32(0.693359375)  # nine bits: its product with an integer below 2**15 is exact
_LN2_LOW = np.float32(math.log(2.0) - 0.693359375)
_EXP = tuple(np.float32(1.0 / math.factorial(i)) for i in range(6, -1, -1))
# (1 + x) exp(x**2 / 2) Φ(-x) for x >= 0 in t = (x - 3) / (x + 3), to 2.3e-8
_RATIO = tuple(
    np.float32(c) for c in (
        6.261944899485827e-05, 3.593166307622856e-05, -0.0004812877560776958,
        -0.00036574862380308855, 0.002993102136812593, 0.0011643253288702042, -0.02272675503958853,
        0.04516336581453794, -0.016432321142273568, -0.09652673371584654, 0.4860557934222487,
    )
)  # fmt: skip
_FARTHEST = np.float32(12.0)  # where exp(-x**2 / 2) is a normal number
_EXPONENT_BITS = 23


@intrinsic
def _times_power_of_two(typing_context, x, shifted):
    """``x * 2**k`` for a ``shifted`` with k in its lowest bits."""

    def code(context, builder, signature, arguments):
        word = ir.IntType(32)
        bits, k = (builder.bitcast(a, word) for a in arguments)
        k = builder.shl(k, ir.Constant(word, _EXPONENT_BITS))
        return builder.bitcast(builder.add(bits, k), ir.FloatType())

    return types.float32(types.float32, types.float32), code


@inlined
def exp(x):
    """exp(x) for -80 <= x <= 0, to a relative 2e-7."""
    shifted = fma(x, _LOG2_E, _ROUND)
    k = shifted - _ROUND
    r = fma(-k, _LN2_LOW, fma(-k, _LN2_HIGH, x))
    return _times_power_of_two(polynomial(r, _EXP), shifted)


@inlined
def normal_probability(z):
    """Φ(z), to an absolute 2e-7."""
    x = abs(z)
    x = _FARTHEST if x > _FARTHEST else x
    one, three = x + ONE, x + THREE
    inverse = ONE / (one * three)
    ratio = polynomial((x - THREE) * one * inverse, _RATIO)
    tail = exp(-HALF * x * x) * ratio * (three * inverse)
    return tail if z <= ZERO else ONE - tail
