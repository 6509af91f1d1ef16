"""Quantiles of small counts, found by adding probabilities from zero upwards.

All sums are compared with the probability sought, without a branch, so that loops over members
vectorise.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from pymc_statespace_filters.compiler.native.jit import inlined
from pymc_statespace_filters.compiler.numerics.exponential import log1p
from pymc_statespace_filters.compiler.numerics.quantiles.normal import short_exp, short_tail

N_TERMS = 24
"""Numbers from this one on are undecided; with a mean of 8 one in 150 000 is."""

UNDECIDED = -1.0
TWO_52 = 2.0**52


def _counted(builder: Any, first: Any, factor: Any, low: Any, high: Any) -> Any:
    """How many partial sums are below ``low`` and ``high``; undecided where these differ.

    Term j + 1 is term j times ``factor(j)`` / (j + 1).
    """
    double, whole = ir.DoubleType(), ir.IntType(64)
    power = total = first
    counts = [ir.Constant(whole, 0)] * 2
    divisor = 1.0
    for j in range(N_TERMS):
        below = [builder.fcmp_ordered("<", total, limit) for limit in (low, high)]
        counts = [
            builder.sub(count, builder.sext(b, whole))
            for count, b in zip(counts, below, strict=True)
        ]
        power, divisor = builder.fmul(power, factor(j)), divisor / (j + 1)
        total = builder.fma(power, ir.Constant(double, divisor), total)
    decided = builder.icmp_signed("==", *counts)
    decided = builder.and_(
        decided, builder.icmp_signed("<", counts[1], ir.Constant(whole, N_TERMS))
    )
    # Adding a small whole number to the bits of 2**52 adds it to 2**52.
    bits = builder.add(counts[0], builder.bitcast(ir.Constant(double, TWO_52), whole))
    count = builder.fsub(builder.bitcast(bits, double), ir.Constant(double, TWO_52))
    return builder.select(decided, count, ir.Constant(double, UNDECIDED))


@intrinsic
def _count_poisson(typing_context, first, mean, low, high):
    def code(context, builder, signature, arguments):
        first, mean, low, high = arguments
        return _counted(builder, first, lambda j: mean, low, high)

    return types.float64(*[types.float64] * 4), code


@intrinsic
def _count_binomial(typing_context, first, n, odds, low, high):
    def code(context, builder, signature, arguments):
        first, n, odds, low, high = arguments
        product = builder.fmul(n, odds)

        def factor(j):  # (n - j) odds
            return builder.fma(ir.Constant(ir.DoubleType(), -float(j)), odds, product)

        return _counted(builder, first, factor, low, high)

    return types.float64(*[types.float64] * 5), code


@inlined
def _limits(z):
    """Φ(z) less and more the largest errors of it and of the sums."""
    tail = short_tail(abs(z))
    sought = tail if z <= 0.0 else 1.0 - tail
    error = 1e-7 * tail + 3e-8
    return sought - error, sought + error


@inlined
def small_poisson(z, mean):
    """The Poisson quantile, or `UNDECIDED`, for a mean below 8."""
    low, high = _limits(z)
    return _count_poisson(short_exp(-mean), mean, low, high)


@inlined
def small_binomial(z, n, p):
    """The binomial quantile, or `UNDECIDED`, for n p < 8 and p <= 1/2."""
    low, high = _limits(z)
    return _count_binomial(short_exp(n * log1p(-p)), n, p / (1.0 - p), low, high)
