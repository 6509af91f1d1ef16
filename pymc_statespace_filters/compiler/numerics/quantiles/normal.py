"""The standard normal distribution function, both tails alike."""

from ...native.jit import inlined
from ..exponential import exp
from ..intrinsics import fma, polynomial

FARTHEST = 37.0
"""Standard deviations beyond which a normal counts as if it were there."""

# (1 + x) exp(x**2 / 2) Φ(-x) for x >= 0, a Chebyshev interpolant in t = (x - 5) / (x + 5),
# computed with 60 digits; the variable is that of Shepherd and Laframboise (1981).
_RATIO = (
    -3.9886338590692045e-10, -2.8233272215141205e-10, 4.500725392479864e-09,
    3.6280682399194867e-09, -3.120147211147667e-08, -2.6287875968778985e-08,
    1.9663442631364518e-07, 1.278804945396261e-07, -1.3077682743993349e-06,
    -7.034836922558877e-08, 9.060011716331426e-06, -9.896096712884405e-06,
    -5.3607652870422455e-05, 0.00018233414474988366, 7.79161509574746e-06,
    -0.0016760723444742157, 0.006522000665119207, -0.015170415402525146, 0.02453696324390185,
    -0.02640104296630763, 0.010002352385220747, 0.03103036842596369, -0.09155228183400893,
    0.46151582985003775,
)  # fmt: skip


@inlined
def limited(z):
    """A normal within 37 standard deviations; NaN stays NaN."""
    z = -FARTHEST if z < -FARTHEST else z
    return FARTHEST if z > FARTHEST else z


@inlined
def tail(x):
    """Φ(-x) for 0 <= x <= 37, to 3 ulp."""
    square = x * x
    lost = fma(x, x, -square)
    one, five = x + 1.0, x + 5.0
    inverse = 1.0 / (one * five)
    ratio = polynomial((x - 5.0) * one * inverse, _RATIO)
    return exp(-0.5 * square) * fma(-0.5 * lost, ratio, ratio) * (five * inverse)


@inlined
def normal_probability(z):
    """Φ(z)."""
    z = limited(z)
    p = tail(abs(z))
    return p if z <= 0.0 else (1.0 - p if z > 0.0 else z)
