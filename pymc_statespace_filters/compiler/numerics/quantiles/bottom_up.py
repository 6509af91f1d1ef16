"""Quantiles of small counts, found by adding probabilities from zero upwards.

All sums are compared with the probability sought, without a branch, so that loops over members
vectorise. The numbers are scaled by P(N = 0), so the first term is 1.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from pymc_statespace_filters.compiler.native.jit import inlined
from pymc_statespace_filters.compiler.numerics.exponential import exp
from pymc_statespace_filters.compiler.numerics.quantiles.normal import short_tail_ratio

N_TERMS = 24
"""Numbers from this one on are undecided; with a mean of 8 one in 150 000 is."""

UNDECIDED = -1.0


def _counted(builder: Any, factor: Any, low: Any, high: Any) -> Any:
    """How many partial sums are below ``low`` and ``high``; undecided where these differ.

    Term j + 1 is term j times ``factor(j)`` / (j + 1).
    """
    double = ir.DoubleType()
    constant = lambda x: ir.Constant(double, x)  # noqa: E731
    term = total = constant(1.0)
    counts = [constant(0.0), constant(0.0)]
    for j in range(N_TERMS):
        counts = [
            builder.fadd(count, builder.uitofp(builder.fcmp_ordered("<", total, limit), double))
            for count, limit in zip(counts, (low, high), strict=True)
        ]
        term = builder.fmul(term, builder.fmul(factor(j), constant(1.0 / (j + 1))))
        total = builder.fadd(total, term)
    decided = builder.fcmp_ordered("==", *counts)
    decided = builder.and_(decided, builder.fcmp_ordered("<", counts[1], constant(N_TERMS)))
    return builder.select(decided, counts[0], constant(UNDECIDED))


@intrinsic
def count_poisson(typing_context, mean, low, high):
    """The least k whose scaled P(N <= k) is not below the limits, for a Poisson number."""

    def code(context, builder, signature, arguments):
        mean, low, high = arguments
        return _counted(builder, lambda j: mean, low, high)

    return types.float64(types.float64, types.float64, types.float64), code


@intrinsic
def count_binomial(typing_context, n, odds, low, high):
    """The same for successes in n trials, whose odds are p / (1 - p)."""

    def code(context, builder, signature, arguments):
        n, odds, low, high = arguments
        rest = lambda j: builder.fsub(n, ir.Constant(ir.DoubleType(), float(j)))  # noqa: E731
        return _counted(builder, lambda j: builder.fmul(rest(j), odds), low, high)

    return types.float64(*[types.float64] * 4), code


@inlined
def limits(z, log_scale):
    """Φ(z) exp(log_scale), less and more than its possible error."""
    scale = exp(log_scale)
    tail = exp(log_scale - 0.5 * z * z) * short_tail_ratio(abs(z))
    sought = tail if z <= 0.0 else scale - tail
    error = 5e-8 * tail + 1e-14 * scale
    return sought - error, sought + error
