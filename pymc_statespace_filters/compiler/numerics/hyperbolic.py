"""Hyperbolic functions for vector code, by the rules of `exponential`."""

from ..native.jit import inlined
from .exponential import exp, exp_times
from .intrinsics import fma, polynomial, sign_bit, with_sign

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
