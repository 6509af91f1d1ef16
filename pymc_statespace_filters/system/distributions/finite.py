"""Laws of variables that take finitely many whole values: probabilities, and where these are.

Probabilities, not their logarithms: those of impossible values are zero, and so are their
derivatives.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pytensor.tensor as pt
import pytensor.tensor.random.basic as ptr
from pymc.distributions.discrete import DiscreteUniformRV
from pytensor.tensor.variable import TensorVariable

MAX_TRIALS = 1000
"""Of a binomial variable: beyond, its coefficients overflow."""


@dataclass(frozen=True)
class FiniteLaw:
    """A law of whole numbers from the first to the second of its ``bounds``, both included.

    ``probability(v, ...)`` of a value within them is a function of the parameters, and zero
    elsewhere. It is that of the law where ``is_valid``.
    """

    probability: Callable[..., TensorVariable]
    bounds: Callable[..., Sequence[Any]]
    is_valid: Callable[..., TensorVariable]


def _binomial(v, n, p):
    """n over v times p^v (1 - p)^(n - v), whose derivative is finite at p = 0 and 1."""
    inside = (v >= 0) & (v <= n)
    v = pt.switch(inside, v, 0.0)
    log_coefficient = pt.gammaln(n + 1) - pt.gammaln(v + 1) - pt.gammaln(n - v + 1)
    return pt.switch(inside, pt.exp(log_coefficient) * _power(p, v) * _power(1 - p, n - v), 0.0)


def _power(p, v):
    """p^v, and 1 where v is 0, with a derivative there."""
    return pt.switch(pt.eq(v, 0), 1.0, pt.pow(pt.switch(pt.eq(v, 0), 1.0, p), v))


def _categorical(v, p):
    parts = [pt.switch(pt.eq(v, k), p[..., k], 0.0) for k in range(p.type.shape[-1])]
    return sum(parts[1:], start=parts[0])


def are_probabilities(p: TensorVariable) -> TensorVariable:
    """Whether vectors along the last axis are probabilities of all that may happen."""
    return pt.all(p >= 0, axis=-1) & (abs(pt.sum(p, axis=-1) - 1.0) < 1e-6)


FINITE_LAWS: dict[type, FiniteLaw] = {
    ptr.BernoulliRV: FiniteLaw(
        lambda v, p: pt.switch(pt.eq(v, 1), p, pt.switch(pt.eq(v, 0), 1 - p, 0.0)),
        lambda p: (0.0, 1.0),
        lambda p: (p >= 0) & (p <= 1),
    ),
    ptr.BinomialRV: FiniteLaw(
        _binomial,
        lambda n, p: (0.0, n),
        lambda n, p: (p >= 0) & (p <= 1) & (n >= 0) & pt.eq(n % 1, 0),
    ),
    ptr.CategoricalRV: FiniteLaw(
        _categorical, lambda p: (0.0, p.type.shape[-1] - 1.0), are_probabilities
    ),
    DiscreteUniformRV: FiniteLaw(
        lambda v, lower, upper: pt.switch(
            (v >= lower) & (v <= upper), 1 / (upper - lower + 1), 0.0
        ),
        lambda lower, upper: (lower, upper),
        lambda lower, upper: lower <= upper,
    ),
}
