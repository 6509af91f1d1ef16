"""Machine instructions that numba does not expose, and the compilation of functions built on them.

Such functions have neither branches nor calls, so that loops around them vectorise. None of them
uses fast-math flags: the caller's flags (`jit.FAST_MATH`) do not apply inside an inlined
function, so error-free transformations are computed as written, and a result does not depend on
whether the loop around it was vectorised.
"""

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ..native.jit import inlined

ROUND = 6755399441055744.0  # 1.5 * 2**52: adding it rounds to an integer, held in the lowest bits
_ROUND_BIASED = ROUND + 1023.0
_EXPONENT_BITS = np.uint64(52)
_SIGN = np.uint64(0x8000000000000000)


def _precision(a):
    return types.float32 if a == types.float32 else types.float64


@intrinsic
def fma(typing_context, a, b, c):
    """``a * b + c``, rounded once; a slow call on processors without the instruction.

    In single precision if ``a`` is.
    """

    def code(context, builder, signature, arguments):
        return builder.fma(*arguments)

    kind = _precision(a)
    return kind(kind, kind, kind), code


@intrinsic
def sqrt(typing_context, x):
    """The square root, correctly rounded; NaN for negative numbers."""

    def code(context, builder, signature, arguments):
        function = builder.module.declare_intrinsic("llvm.sqrt", [ir.DoubleType()])
        return builder.call(function, arguments)

    return types.float64(types.float64), code


@intrinsic
def polynomial(typing_context, x, coefficients):
    """A polynomial in x by Horner's rule; the coefficients are a tuple, highest power first.

    In single precision if x and the coefficients are.
    """

    def code(context, builder, signature, arguments):
        argument, packed = arguments
        total, *rest = cgutils.unpack_tuple(builder, packed)
        for coefficient in rest:
            total = builder.fma(total, argument, coefficient)
        return total

    kind = _precision(x)
    return kind(kind, coefficients), code


@intrinsic
def bits_of(typing_context, x):
    """The 64 bits of a float64, as uint64."""

    def code(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.IntType(64))

    return types.uint64(types.float64), code


@intrinsic
def float_of(typing_context, bits):
    """The float64 with these 64 bits."""

    def code(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.DoubleType())

    return types.float64(types.uint64), code


@inlined
def power_of_two(k):
    """2**k for a whole number k between -1022 and 1023."""
    return float_of(bits_of(k + _ROUND_BIASED) << _EXPONENT_BITS)


@inlined
def sign_bit(x):
    """The bits of the zero with the sign of x."""
    return bits_of(x) & _SIGN


@inlined
def with_sign(magnitude, sign):
    """A non-negative ``magnitude`` with the sign from `sign_bit`."""
    return float_of(bits_of(magnitude) | sign)
