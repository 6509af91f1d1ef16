"""Parts of exact binomial and Poisson probabilities, and the search for a quantile by them.

Probabilities have the saddle-point form of Loader (2000, "Fast and accurate computation of binomial
probabilities"), which loses no digits for large numbers.
"""

import math
from typing import Any

import numpy as np

from ...native.jit import njit_internal
from ..exponential import log

TWO_PI = 2.0 * math.pi

# log(k!) minus Stirling's formula, for k up to 16
_STIRLING_ERRORS = (
    0.0, 0.08106146679532726, 0.0413406959554093, 0.02767792568499834, 0.020790672103765093,
    0.016644691189821193, 0.013876128823070748, 0.01189670994589177, 0.010411265261972096,
    0.009255462182712733, 0.00833056343336287, 0.007573675487951841, 0.00694284010720953,
    0.006408994188004207, 0.0059513701127588475, 0.005554733551962801, 0.0052076559196096404,
)  # fmt: skip


@njit_internal
def stirling_error(k):
    """log(k!) - log(sqrt(2 π k)) - k log(k) + k for a whole number k; 0 for k = 0."""
    if k < 16.5:
        return _STIRLING_ERRORS[int(k)]
    a = 1.0 / (k * k)
    series = 1.0 / 1260.0 - a * (1.0 / 1680.0 - a * (1.0 / 1188.0 - a * (691.0 / 360360.0)))
    return (1.0 / 12.0 - a * (1.0 / 360.0 - a * series)) / k


@njit_internal
def deviance(x, mean):
    """x log(x / mean) + mean - x for x > 0, without cancellation next to the mean."""
    v = (x - mean) / (x + mean)
    if abs(v) > 0.1:
        return x * log(x / mean) + mean - x
    square = v * v
    total, term, divisor = (x - mean) * v, 2.0 * x * v, 1.0
    while True:
        term *= square
        divisor += 2.0
        larger = total + term / divisor
        if larger == total:
            return total
        total = larger


def smallest_reached(reached: Any) -> Any:
    """A search for the least whole number k with ``reached(k, z, a, b)``, which grows with k.

    ``search(guess, largest, z, a, b)`` looks next to the guess first; the largest k counts
    as reached.
    """

    @njit_internal
    def search(guess, largest, z, a, b):
        above, step = min(max(np.floor(guess), 0.0), largest), 1.0
        while above < largest and not reached(above, z, a, b):
            above, step = min(above + step, largest), 2.0 * step
        below, step = above - 1.0, 1.0
        while below >= 0.0 and reached(below, z, a, b):
            above, below, step = below, below - step, 2.0 * step
        below = max(below, -1.0)
        while above - below > 1.0:
            middle = np.floor(0.5 * (above + below))
            if reached(middle, z, a, b):
                above = middle
            else:
                below = middle
        return above

    return search
