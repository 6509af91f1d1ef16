"""Cornish-Fisher series of the binomial and Poisson quantiles, and exact probabilities.

With X = k + 1 as a continuous variable, P(N <= k) = I_q(n + 1 - X, X) defines a smooth quantile
X(z), and the least k with P(N <= k) >= Φ(z) is floor(X(z)), or X(z) - 1 where that is whole. In
inverse powers of the standard deviation s, with d = 1 - 2p,

    X = n p + s z + 1/2 + d Σ A_i(z**2, d**2) / s**(2i) + z / s Σ B_i(z**2, d**2) / s**(2i),

where A_i and B_i are polynomials. They follow from ∂X/∂p φ(z) = ∂X/∂z f(X), in which f is minus the
derivative of P(N <= k) by p, by Stirling's series, order by order in exact fractions. With d = 1
and s**2 the mean, the series is that of the Poisson quantile. The use of such series for numbers
that are then rounded down is that of Giles (2016, ACM TOMS 42:7) and of Giles and Beentjes (2024,
ACM TOMS 50:3).

Probabilities have the saddle-point form of Loader (2000, "Fast and accurate computation of binomial
probabilities"), which loses no digits for large numbers.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from ...native.jit import inlined, njit_internal
from ..exponential import log

# A_0 ... A_3 and B_0 ... B_2: rows are powers of z**2, columns powers of d**2.
_EVEN = (
    (
        (-0.16666666666666666,),
        (0.16666666666666666,),
    ),
    (
        (-0.022222222222222223, 0.0024691358024691358),
        (0.009722222222222222, -0.0010802469135802468),
        (0.004166666666666667, -0.000462962962962963),
    ),
    (
        (0.0013227513227513227, -0.002175191064079953, 0.00022535763276504018),
        (-0.010189318783068783, -0.0023800338036449147, -0.0001413078091318832),
        (0.0008887235449735449, 0.0008019179894179895, -3.7202380952380956e-05),
        (0.00041335978835978834, 0.00014329805996472663, 1.8371546149323928e-06),
    ),
    (
        (0.001009700176366843, 0.0006902802273172643, -0.00013505127702658566,
         5.0986710794666895e-06),
        (0.00016117587081128747, -0.0025727092212913974, -0.00042455750089816447,
         -1.4882795205797606e-05),
        (-0.0026917874595825983, -0.003493414566186557, -0.00013848701131687242,
         -1.3485225194330133e-06),
        (0.00011548813198118754, 0.0003089711321771507, 3.365820350774054e-05,
         6.540610642976899e-07),
        (4.925870811287478e-05, 7.360100676072898e-05, 4.478064373897707e-06,
         3.827405447775818e-08),
    ),
)  # fmt: skip
_ODD = (
    (
        (0.020833333333333332, -0.04861111111111111),
        (-0.020833333333333332, 0.006944444444444444),
    ),
    (
        (0.007855902777777778, 0.010098379629629629, -0.0006960519547325103),
        (-0.0005208333333333333, -0.003414351851851852, 0.00041152263374485596),
        (-0.0005642361111111111, -0.00078125, 1.4467592592592593e-05),
    ),
    (
        (-0.0005827081266534392, 0.0013620807842813052, 0.0010600965807490692,
         3.080178955870185e-05),
        (0.0014991612240961199, 0.006896107184193122, 0.0005825033604619831,
         3.07805261951031e-05),
        (-5.5243813381834216e-05, -0.0006229934826940035, -0.0001673045037845385,
         -4.627971087268927e-07),
        (-3.7589905753968256e-05, -0.000194304935515873, -2.575748181216931e-05,
         -3.9900701793062907e-07),
    ),
)  # fmt: skip

TWO_PI = 2.0 * math.pi
# log(k!) minus Stirling's formula, for k up to 16
_STIRLING_ERRORS = (
    0.0, 0.08106146679532726, 0.0413406959554093, 0.02767792568499834, 0.020790672103765093,
    0.016644691189821193, 0.013876128823070748, 0.01189670994589177, 0.010411265261972096,
    0.009255462182712733, 0.00833056343336287, 0.007573675487951841, 0.00694284010720953,
    0.006408994188004207, 0.0059513701127588475, 0.005554733551962801, 0.0052076559196096404,
)  # fmt: skip


def in_variables(table: Sequence, n: int) -> Any:
    """The polynomial in n variables with the coefficients ``table[i][j]...`` of a**i b**j ..."""

    def code(context, builder, signature, arguments):
        return _horner(builder, table, arguments)

    kinds = types.float64(*[types.float64] * n)
    forms = (
        lambda typing_context, a: (kinds, code),
        lambda typing_context, a, b: (kinds, code),
        lambda typing_context, a, b, c: (kinds, code),
    )
    return intrinsic(forms[n - 1])


def _horner(builder: Any, coefficients: Any, variables: Sequence) -> Any:
    if not variables:
        return ir.Constant(ir.DoubleType(), coefficients)
    *rest, total = (_horner(builder, c, variables[1:]) for c in coefficients)
    for term in reversed(rest):
        total = builder.fma(total, variables[0], term)
    return total


_even, _odd = in_variables(_EVEN, 3), in_variables(_ODD, 3)
_short_even, _short_odd = in_variables(_EVEN[:3], 3), in_variables(_ODD[:2], 3)


@inlined
def series(z, deviation, d):
    """X(z) - n p to the order s**-6."""
    inverse = 1.0 / deviation
    a, b, c = inverse * inverse, z * z, d * d
    return deviation * z + (0.5 + d * _even(a, b, c) + z * inverse * _odd(a, b, c))


@inlined
def short_series(z, deviation, d):
    """X(z) - n p to the order s**-4, and a bound of its error for s >= 2."""
    inverse = 1.0 / deviation
    a, b, c = inverse * inverse, z * z, d * d
    value = deviation * z + (0.5 + d * _short_even(a, b, c) + z * inverse * _short_odd(a, b, c))
    x = inverse * (abs(z) + 1.5)
    x3 = x * x * x
    error = (deviation * x3) * (deviation * x3) * x * (1.5e-4 + 0.8e-4 * x3 * x)
    return value, error + 1e-15 * deviation * abs(z)


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
