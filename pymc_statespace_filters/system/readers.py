"""Which observables depend on which states, by trial: it decides when an accumulator was seen."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.traversal import ancestors
from pytensor.tensor.random.type import RandomType

from .random_variables import is_drawn

if TYPE_CHECKING:
    from .model import StateSpaceModel

_N_TRIALS = 8
_STATE = 1  # of the inputs of a traced function


def observables_that_read(system: "StateSpaceModel", states: Sequence[int]) -> np.ndarray:
    """A table (p, len(states)) of ones and zeros: which observables depend on which states.

    All do on a state that none is found to depend on, and where a density is of all observables
    together.
    """
    if system.p == 1 or system.equations.observation is system.equations.observation_draw:
        return np.ones((system.p, len(states)), dtype=np.int64)
    found = np.stack([_change(system, i) for i in states], axis=1)
    return np.where(found.any(axis=0), found, True).astype(np.int64)


def counts(system: "StateSpaceModel") -> list[bool]:
    """Which observables have a distribution of whole numbers."""
    graph = system.equations.observation_draw
    if graph is None:
        return [False] * system.p
    (whole,) = graph.outputs
    drawn = [element.owner.inputs[0] for element in whole.owner.inputs if element.owner.inputs]
    return ["int" in getattr(variable.type, "dtype", "") for variable in drawn]


def _change(system: "StateSpaceModel", state: int) -> np.ndarray:
    """Which observables (p,) change with a state, at some random points."""
    inputs, parts = _parts(system)
    function = pytensor.function(inputs, parts, mode="FAST_COMPILE", on_unused_input="ignore")
    rng, changes = np.random.default_rng(0), np.zeros(system.p, bool)
    with np.errstate(all="ignore"):
        for trial in range(_N_TRIALS):
            # Of all sizes, as an observable may have a threshold; mostly positive, as may be due.
            point = [rng.normal(size=v.type.shape) * 10 ** rng.uniform(-2, 2) for v in inputs]
            point = [np.abs(value) if trial % 4 else value for value in point]
            before = function(*point)
            point[_STATE][state] *= 10 ** rng.uniform(0.1, 2)
            pairs = zip(before, function(*point), strict=True)
            changes |= [not np.array_equal(a, b, equal_nan=True) for a, b in pairs]
    return changes


def _parts(system: "StateSpaceModel") -> tuple[list[Variable], list[Variable]]:
    """Symbols, and what each observable is a function of: itself, or parameters of its law."""
    equations = system.equations
    graph = equations.observation or equations.observation_draw
    assert graph is not None
    inputs = [v.type() for v in graph.inputs]
    (whole,) = graph.bind(inputs)
    symbols = [v for v in inputs if not isinstance(v.type, RandomType)]
    if equations.observation is not None:
        return symbols, [whole[i] for i in range(system.p)]
    return symbols, [_parameters(element) for element in whole.owner.inputs]


def _parameters(draw: Variable) -> Variable:
    """The parameters of all distributions behind a draw, in one vector."""
    nodes = _nodes_behind(draw)
    numbers = [
        v
        for node in nodes
        if is_drawn(node)
        for v in node.inputs
        # Components of a mixture are drawn themselves, and have parameters of their own.
        if hasattr(v.type, "dtype") and not any(map(is_drawn, _nodes_behind(v)))
    ]
    return pt.concatenate([pt.cast(v, "float64").ravel() for v in numbers])


def _nodes_behind(variable: Variable) -> list[Apply]:
    return list(dict.fromkeys(v.owner for v in ancestors([variable]) if v.owner is not None))
