"""A deterministic filter as graphs of three functions of one vector ``s``, carried along a record.

The likelihood takes one pass; for a derivative the pass also leaves a tape of its states, along
which their vector-Jacobian products go back.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.graph.replace import graph_replace
from pytensor.tensor.variable import TensorVariable

from ...compiler.codegen.function_types import Graph
from ...system.model import StateSpaceModel

MAX_EXPLICIT = 8  # states


@dataclass(frozen=True, eq=False)
class GaussianFilterFunctions:
    """A filter's functions for one system; the first ``system.n`` entries of s are the mean.

    * ``start``: theta -> s at step 0.
    * ``predict``: theta, u, t, s -> s of the next step.
    * ``update``: theta, u, t, d, s -> s, and the term log p(d_j | d_1 .. d_{j-1}).

    ``has_short_rows`` says whether a row of the Jacobian of a prediction takes few operations.
    """

    system: StateSpaceModel
    has_short_rows: bool
    start: Graph
    predict: Graph
    update: Graph

    @property
    def size(self) -> int:
        """Length of s."""
        return self.predict.inputs["s"].type.shape[0]


def vjps(recursion: GaussianFilterFunctions, *, explicit: bool) -> tuple[Graph, Graph, Graph]:
    """Vector-Jacobian products of start, predict and update.

    They take ``s_bar``, the cotangent of s, and ``c_bar``, that of theta, to which each adds; that
    of update takes ``term_bar`` too. They are linear in the cotangent, which is their only input
    from the later step.

    If ``explicit``, the row of the Jacobian for each of the first elements of the cotangent is
    computed explicitly: the processor does so ahead of time, and the cotangent then takes one
    multiplication. The other elements are propagated through the equations, with fewer operations
    in all. The numbers of explicit elements were chosen by measurement: with ten states rows no
    longer pay, and twenty would take 15 s to write out. A linearisation that evaluates the
    equations at many points has none, because each row is as long as a propagation; records side by
    side have none, because they fill the time in which a single one waits.
    """
    theta, s = (recursion.predict.inputs[name] for name in ("theta", "s"))
    s_bar, c_bar = s.type("s_bar"), theta.type("c_bar")
    term_bar = pt.tensor("term_bar", shape=(), dtype="float64")
    n, size = recursion.system.n, recursion.size
    of_predict, of_update = size if n == 1 else n, size + 1 if n <= 2 else 0
    if n > MAX_EXPLICIT:
        of_predict = 0
    if not explicit:
        of_predict = of_update = 0

    def vjp(part: Graph, wrt: list, cotangents: dict, n_explicit: int) -> Graph:
        values = list(cotangents.values())
        *states_bar, theta_bar = _pullback(part.outputs, values, wrt, n_explicit)
        inputs = {**part.inputs, **cotangents, "c_bar": c_bar}
        return Graph(inputs, [*states_bar, c_bar + theta_bar])

    state, state_and_term = {"s_bar": s_bar}, {"s_bar": s_bar, "term_bar": term_bar}
    return (
        vjp(recursion.start, [theta], state, 0),
        vjp(recursion.predict, [s, theta], state, of_predict),
        vjp(recursion.update, [s, theta], state_and_term, of_update),
    )


def _pullback(
    outputs: Sequence[TensorVariable],
    cotangents: Sequence[TensorVariable],
    wrt: Sequence[TensorVariable],
    n_explicit: int,
) -> list[TensorVariable]:
    """Vector-Jacobian products, the first elements of the cotangents by explicit Jacobian rows."""
    cotangent = pt.concatenate([pt.atleast_1d(c) for c in cotangents])
    symbol = cotangent.type("cotangent")
    ends = np.cumsum([output.type.shape[0] for output in outputs])
    pieces = [symbol[end - o.type.shape[0] : end] for o, end in zip(outputs, ends, strict=True)]
    bars = pytensor.grad(
        None,
        wrt,
        known_grads=dict(zip(outputs, pieces, strict=True)),
        disconnected_inputs="ignore",
        return_disconnected="zero",
    )
    bars = [pt.specify_shape(b, w.type.shape) for b, w in zip(bars, wrt, strict=True)]

    def at(value: Any) -> list[TensorVariable]:
        return graph_replace(bars, {symbol: pt.as_tensor(value)}, strict=False)

    if not n_explicit:
        return at(cotangent)
    totals = at(pt.concatenate([np.zeros(n_explicit), cotangent[n_explicit:]]))
    for i in reversed(range(n_explicit)):
        row = at(np.eye(ends[-1])[i])
        totals = [total + cotangent[i] * entry for total, entry in zip(totals, row, strict=True)]
    return totals
