"""The law of an observation given the state or its moments, of one system at many points.

And which observables are a state, but for their noise.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray

from ..compiler.codegen.expressions import Expression
from ..compiler.codegen.function_types import Graph
from ..compiler.codegen.functions import unrolled
from ..compiler.codegen.scalarize import NotUnrollableError
from ..compiler.lowering.compiled_system import compile_system
from ..compiler.lowering.symbols import call, observation_moments, symbols_of
from ..compiler.native.rows import at_points
from ..system.model import StateSpaceModel

Array = NDArray[np.float64]
_ARGUMENTS = ("x", "t", "u", "theta")


class Moments(NamedTuple):
    """Mean (m, k) and covariance (m, k, k) of vectors; None if they are known."""

    mean: Array
    cov: Array | None


def moments_on_tape(system: StateSpaceModel, tape: Array) -> Moments:
    """Those of the states in rows (m, width) of the tape of a filter of moments."""
    n = system.n
    if compile_system(system).is_deterministic:
        return Moments(tape[:, :n], None)
    position = np.zeros((n, n), dtype=np.int64)
    position[np.tril_indices(n)] = np.arange(n, n + n * (n + 1) // 2)
    return Moments(tape[:, :n], tape[:, np.maximum(position, position.T)])


def moments_of_observations(
    system: StateSpaceModel, states: Moments, t: Array, u: Array, theta: Array
) -> tuple[Array, Array]:
    """Mean (m, p) and covariance (m, p, p) of d = h(x) + e (Eq. 4.4), linearised at the means.

    Of states (m, n), times (m,), inputs (m, n_input_columns) and parameters (m, k); NaN where the
    state is.
    """
    function = _function(system, with_jacobian=states.cov is not None)
    with np.errstate(all="ignore"):
        mean, cov, *jacobian = function(states.mean, t, u, theta)
        if states.cov is not None:
            (C,) = jacobian
            cov = cov + C @ states.cov @ np.swapaxes(C, 1, 2)
    unknown = np.isnan(states.mean).any(axis=1)
    return (
        np.where(unknown[:, None], np.nan, mean),
        np.where(unknown[:, None, None], np.nan, cov),
    )


def sensors_of_states(system: StateSpaceModel) -> dict[str, str]:
    """The first observable of each state that is that state, but for its noise."""
    symbols, observation = symbols_of(system), system.equations.observation
    if observation is None:
        return {}
    without_noise = {name: symbol for name, symbol in symbols.items() if name != "e"}
    try:
        (seen,) = unrolled(Graph(symbols, [call(observation, system, without_noise)]))
    except NotUnrollableError:
        return {}
    states = {f"x.{i}": state for i, state in enumerate(system.states)}
    found: dict[str, str] = {}
    for value, observable in zip(seen, system.observables, strict=True):
        name = value.args[0] if isinstance(value, Expression) and value.op is None else None
        if name in states:
            found.setdefault(states[name], observable)
    return found


@lru_cache(maxsize=64)
def _function(system: StateSpaceModel, *, with_jacobian: bool) -> Callable:
    """h, the covariance of e, and perhaps the Jacobian of h at points, by NumPy.

    All points are evaluated in one call, and machine code would take seconds to compile.
    """
    symbols = symbols_of(system)
    outputs = observation_moments(system, symbols)
    points, graphs = at_points([symbols[name] for name in _ARGUMENTS], outputs)
    if with_jacobian:
        # The gradient of a sum over the points has that of each point in its row.
        rows = [
            pt.grad(graphs[0][:, i].sum(), points[0], disconnected_inputs="ignore")
            for i in range(system.p)
        ]
        graphs.append(pt.stack(rows, axis=1))
    return pytensor.function(
        points, graphs, mode="FAST_COMPILE", on_unused_input="ignore", trust_input=True
    )
