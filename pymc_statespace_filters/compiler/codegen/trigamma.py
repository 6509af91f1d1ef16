"""The second derivative of log Γ in machine code, which PyTensor's numba backend lacks.

It is in the curvature of counts and gamma variables whose shape depends on the state.
"""

import math
from typing import Any

from pytensor.link.numba.dispatch.basic import register_funcify_and_cache_key
from pytensor.scalar.math import TriGamma

from ..native.cache_key import key_of
from ..native.jit import njit_callable

# Bernoulli numbers B_2 to B_14, of the asymptotic series 1/x + 1/(2 x^2) + sum of B_2k / x^(2k+1),
# whose next term is 4e-16 of the sum at x = 10 (Abramowitz and Stegun, 6.4.12).
_BERNOULLI = (1 / 6, -1 / 30, 1 / 42, -1 / 30, 5 / 66, -691 / 2730, 7 / 6)
_LARGE = 10.0


@njit_callable
def trigamma(x: float) -> float:
    """Second derivative of log Γ at a number that may be negative; infinite at 0, -1, -2, ..."""
    total, sign = 0.0, 1.0
    if x <= 0.0:
        total, sign, x = (math.pi / math.sin(math.pi * (x % 1.0))) ** 2, -1.0, 1.0 - x
    while x < _LARGE:
        total += sign / x**2
        x += 1.0
    power, inverse = 1.0 / x, 1.0 / x**2
    series = power + 0.5 * inverse
    for number in _BERNOULLI:
        power *= inverse
        series += number * power
    return total + sign * series


@register_funcify_and_cache_key(TriGamma)
def _machine_code(op: TriGamma, node: Any = None, **_: Any) -> tuple:
    return trigamma, key_of(__name__, repr(_BERNOULLI))
