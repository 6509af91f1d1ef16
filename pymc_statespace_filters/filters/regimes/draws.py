"""What the finite variables of a step may be, given a Gaussian state.

Their probabilities may depend on the state. They are then means over it, and the state given each
of these values is replaced by a Gaussian with its mean and covariance, both by quadrature over the
states on which the probabilities depend.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.graph.replace import graph_replace, vectorize_graph
from pytensor.tensor.variable import TensorVariable

from ...compiler.codegen.semidefinite import semidefinite_root
from ..gaussian.linearization import pack, unpack
from .hybrid import Hybrid, Symbols

N_FIRST, N_OTHERS = 12, 4
"""Nodes along the first axis, and along each other one; even, so that none is at a jump in the
middle."""

Array = NDArray[np.float64]


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
    if not hybrid.deciding:
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
    mean, cov = unpack(state, hybrid.n)
    root = _root_of(cov, hybrid.deciding)
    if len(hybrid.deciding) > 1:
        slope = pytensor.grad(
            probability, x, disconnected_inputs="ignore", return_disconnected="zero"
        )
        root = root @ _reflection(root.T @ graph_replace(slope, {x: mean}, strict=False))
    nodes, weights = _rule(len(hybrid.deciding))
    at = vectorize_graph(probability, {x: mean + pt.constant(nodes) @ root.T})
    joint = at * weights
    total = at @ weights  # sums of more than 32 terms are not for every backend
    is_possible = pt.neq(total, 0.0)
    share = pt.switch(is_possible, joint / pt.switch(is_possible, total, 1.0), weights)
    first = share @ nodes
    second = nodes.T @ (share[:, None] * nodes)
    change = second - first[:, None] * first[None, :] - np.eye(nodes.shape[1])
    return Weighted(total, pack(mean + root @ first, cov + root @ change @ root.T))


def _root_of(cov: TensorVariable, deciding: Sequence[int]) -> TensorVariable:
    """Columns by which d white variables move the state (n, d), which are all of d of the states.

    The rest of the state is independent of them.
    """
    n = cov.type.shape[0]
    order = [*deciding, *(i for i in range(n) if i not in deciding)]
    root = semidefinite_root(cov[order][:, order])
    return root[np.argsort(order)][:, : len(deciding)]


def _reflection(slope: TensorVariable) -> TensorVariable:
    """An orthogonal matrix whose first column is along a vector, if that is not zero.

    A function of one linear combination then changes along the first axis alone.
    """
    d = slope.type.shape[0]
    square = pt.sum(slope**2)
    depends = square > 0.0
    first = np.eye(d)[0]
    unit = pt.switch(depends, slope / pt.sqrt(pt.switch(depends, square, 1.0)), first)
    normal = unit + pt.switch(unit[0] < 0.0, -first, first)
    return np.eye(d) - 2.0 * normal[:, None] * normal[None, :] / pt.sum(normal**2)


def _rule(d: int) -> tuple[Array, Array]:
    """Nodes (N, d) and weights (N,) of a quadrature over d white variables.

    Gauss and Hermite's along the first, times the mean of theirs along each of the others, which
    is stretched so that the second moments are right.
    """
    first, weights = _gauss_hermite(N_FIRST)
    if d == 1:
        return first[:, None], weights
    line, weights_on_line = _gauss_hermite(N_OTHERS)
    others = np.kron(np.eye(d - 1), np.sqrt(d - 1) * line[:, None])
    weights_of_others = np.tile(weights_on_line / (d - 1), d - 1)
    nodes = np.column_stack([np.repeat(first, len(others)), np.tile(others, (N_FIRST, 1))])
    return nodes, np.asarray(np.kron(weights, weights_of_others), dtype=np.float64)


def _gauss_hermite(n: int) -> tuple[Array, Array]:
    nodes, weights = np.polynomial.hermite_e.hermegauss(n)
    return nodes, weights / weights.sum()


def total_of(numbers: Sequence[TensorVariable]) -> TensorVariable:
    """The sum of some numbers, at least one."""
    return numbers[0] if len(numbers) == 1 else pt.add(*numbers)
