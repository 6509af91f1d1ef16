"""Quantiles of small counts, found by adding probabilities from zero upwards.

All sums are compared with the probability sought, without a branch, so that loops over members
vectorise.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from pymc_statespace_filters.compiler.native.jit import inlined
from pymc_statespace_filters.compiler.numerics.intrinsics import polynomial
from pymc_statespace_filters.compiler.numerics.quantiles.normal import short_exp, short_tail

SMALL = 8.0
"""Means below are small."""

TINY = 3.0
"""Means below are tiny."""

# Numbers from these on are undecided: one in 4000 draws of the largest mean.
_N_TERMS = {SMALL: 20, TINY: 12}

UNDECIDED = -1.0
TWO_52 = 2.0**52

# artanh(s) / s in s**2 for s <= 1/3: Taylor, truncation 2e-10
_ARTANH = tuple(1.0 / i for i in range(17, 0, -2))


def _counted(builder: Any, n_terms: int, first: Any, factor: Any, low: Any, high: Any) -> Any:
    """How many partial sums are below ``low`` and ``high``; undecided where these differ.

    Term j + 1 is term j times ``factor(j)`` / (j + 1).
    """
    double, whole = ir.DoubleType(), ir.IntType(64)
    power = total = first
    counts = [ir.Constant(whole, 0)] * 2
    divisor = 1.0
    for j in range(n_terms):
        below = [builder.fcmp_ordered("<", total, limit) for limit in (low, high)]
        counts = [
            builder.sub(count, builder.sext(b, whole))
            for count, b in zip(counts, below, strict=True)
        ]
        power, divisor = builder.fmul(power, factor(j)), divisor / (j + 1)
        total = builder.fma(power, ir.Constant(double, divisor), total)
    decided = builder.icmp_signed("==", *counts)
    decided = builder.and_(
        decided, builder.icmp_signed("<", counts[1], ir.Constant(whole, n_terms))
    )
    # Adding a small whole number to the bits of 2**52 adds it to 2**52.
    bits = builder.add(counts[0], builder.bitcast(ir.Constant(double, TWO_52), whole))
    count = builder.fsub(builder.bitcast(bits, double), ir.Constant(double, TWO_52))
    return builder.select(decided, count, ir.Constant(double, UNDECIDED))


def _poisson_counter(n_terms: int) -> Any:
    @intrinsic
    def count(typing_context, first, mean, low, high):
        def code(context, builder, signature, arguments):
            first, mean, low, high = arguments
            return _counted(builder, n_terms, first, lambda j: mean, low, high)

        return types.float64(*[types.float64] * 4), code

    return count


def _binomial_counter(n_terms: int) -> Any:
    @intrinsic
    def count(typing_context, first, n, odds, low, high):
        def code(context, builder, signature, arguments):
            first, n, odds, low, high = arguments
            product = builder.fmul(n, odds)

            def factor(j):  # (n - j) odds
                return builder.fma(ir.Constant(ir.DoubleType(), -float(j)), odds, product)

            return _counted(builder, n_terms, first, factor, low, high)

        return types.float64(*[types.float64] * 5), code

    return count


@inlined
def _limits(z):
    """Φ(z) less and more the largest errors of it and of the sums."""
    tail = short_tail(abs(z))
    sought = tail if z <= 0.0 else 1.0 - tail
    error = 1e-7 * tail + 4e-8
    return sought - error, sought + error


def bottom_up_poisson(largest: float) -> Any:
    """The Poisson quantile of (z, mean), or `UNDECIDED`, for a mean up to ``largest``."""
    count = _poisson_counter(_N_TERMS[largest])

    @inlined
    def quantile(z, mean):
        low, high = _limits(z)
        return count(short_exp(-mean), mean, low, high)

    return quantile


def bottom_up_binomial(largest: float) -> Any:
    """The binomial quantile of (z, n, p), or `UNDECIDED`, for n p to ``largest`` and p <= 1/2."""
    count = _binomial_counter(_N_TERMS[largest])

    @inlined
    def quantile(z, n, p):
        low, high = _limits(z)
        q, two = 1.0 - p, 2.0 - p
        inverse = 1.0 / (q * two)
        s = p * (q * inverse)  # log(1 - p) = -2 artanh(s)
        log_q = -2.0 * s * polynomial(s * s, _ARTANH)
        return count(short_exp(n * log_q), n, p * (two * inverse), low, high)

    return quantile
