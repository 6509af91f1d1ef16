"""What the finite variables of a step may be, given a Gaussian state.

Their probabilities may depend on the state. They are then means over it, and the state given each
of these values is replaced by a Gaussian with its mean and covariance, both by Gauss and Hermite's
quadrature along one line: the one along which the probability changes at the mean. That is all of
the state on which a function of one linear combination depends.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.graph.replace import graph_replace
from pytensor.tensor.variable import TensorVariable

from ..gaussian.linearization import pack, unpack
from .hybrid import Hybrid, Symbols

_N_NODES = 9
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(_N_NODES)
_WEIGHTS /= _WEIGHTS.sum()


class Weighted(NamedTuple):
    """A probability, which need not be normalised, and a vector (mean, covariance)."""

    weight: TensorVariable
    state: TensorVariable


def draws_of(
    hybrid: Hybrid,
    values: Symbols,
    regime: TensorVariable,
    state: TensorVariable,
    drawn: Sequence[TensorVariable],
) -> list[Weighted]:
    """The probability of each of some values, all that there are, and the state given each."""
    if hybrid.regime_forgets_state:
        mean = state[: hybrid.n]
        steps = (hybrid.step(values, regime, mean, v) for v in drawn)
        return [Weighted(step.drawn.probability, state) for step in steps]
    found = [_given(hybrid, values, regime, state, v) for v in drawn]
    total = total_of([part.weight for part in found])
    return [Weighted(part.weight / total, part.state) for part in found]


def _given(
    hybrid: Hybrid,
    values: Symbols,
    regime: TensorVariable,
    state: TensorVariable,
    v: TensorVariable,
) -> Weighted:
    """The mean probability of v, and the state given v."""
    x = pt.tensor("x", shape=(hybrid.n,), dtype="float64")
    probability = hybrid.step(values, regime, x, v).drawn.probability
    slope = pytensor.grad(probability, x, disconnected_inputs="ignore", return_disconnected="zero")
    mean, cov = unpack(state, hybrid.n)
    slope = graph_replace(slope, {x: mean}, strict=False)
    line = cov @ slope
    square = pt.sum(slope * line)
    depends = square > 0.0  # not where it jumps or is certain
    line = pt.switch(depends, line / pt.sqrt(pt.switch(depends, square, 1.0)), 0.0)
    at = [graph_replace(probability, {x: mean + line * node}, strict=False) for node in _NODES]
    joint = [weight * p for weight, p in zip(_WEIGHTS, at, strict=True)]
    total = total_of(joint)
    divisor = pt.switch(pt.eq(total, 0.0), 1.0, total)
    first = total_of([p * node for p, node in zip(joint, _NODES, strict=True)]) / divisor
    second = total_of([p * node**2 for p, node in zip(joint, _NODES, strict=True)]) / divisor
    change = pt.switch(pt.eq(total, 0.0), 0.0, second - first**2 - 1.0)
    given = pack(mean + first * line, cov + change * line[:, None] * line[None, :])
    return Weighted(total, given)


def total_of(numbers: Sequence[TensorVariable]) -> TensorVariable:
    """The sum of some numbers, at least one."""
    return numbers[0] if len(numbers) == 1 else pt.add(*numbers)
