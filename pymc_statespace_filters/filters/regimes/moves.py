"""All that may happen in a step to the parts of a mixture over regimes, for the way back.

A part is a vector: a regime, then mean and covariance of the continuous states given it.
"""

from functools import lru_cache

import pytensor.tensor as pt
from pytensor.graph.replace import graph_replace

from ...compiler.codegen.function_types import Graph, MemberFunction
from ...compiler.codegen.functions import member_function
from ...system.model import StateSpaceModel
from ..gaussian.linearization import Linearization, predict_with_cross
from .draws import draws_of
from .hybrid import hybrid_of
from .particles import ParticleEquations


@lru_cache(maxsize=64)
def moves_of_parts(system: StateSpaceModel, linearization: Linearization) -> MemberFunction:
    """What every part may do, one move after the other: a move for each draw of `Hybrid.drawn`.

    Of a move: its probability; the regime after it; mean and covariance of the continuous states
    given the draw, and those after the step; the covariance (n, n) of both states.
    """
    hybrid = hybrid_of(system)
    equations = ParticleEquations(hybrid, linearization)
    transition = equations.linearizations.transition
    step = predict_with_cross(transition, hybrid.given, equations.given)
    regime, state = equations.parts(equations.particle)
    values, rows = equations.values, []
    drawn = [pt.constant(v) for v in hybrid.drawn]
    parts = draws_of(hybrid, values, regime, state, drawn)
    for v, (probability, before) in zip(drawn, parts, strict=True):
        known = equations.known(values, regime, before, v)
        after, cross = graph_replace(list(step), known, strict=False)
        regime_after = equations.next_regime(regime, before, v)
        rows += [probability[None], regime_after, before, after, cross.ravel()]
    inputs = {"x": equations.particle, **{name: values[name] for name in ("theta", "u", "t")}}
    graph = Graph(inputs, [pt.concatenate(rows)])
    return member_function("moves", "c, inputs, k, t, X, out", graph, "out")
