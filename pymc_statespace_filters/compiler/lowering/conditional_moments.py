"""Mean and covariance of an observation given the state, of a function or of distributions."""

from collections.abc import Mapping

import pytensor.scalar as ps
import pytensor.tensor as pt
from pytensor.tensor.elemwise import Elemwise
from pytensor.tensor.variable import TensorVariable

from ...system.distributions import SCALAR_LAWS, parameters_of
from ...system.model import StateSpaceModel
from .symbols import SYMBOLS, observation_moments, symbols_of


def conditional_moments(
    system: StateSpaceModel, symbols: Mapping[str, TensorVariable]
) -> tuple[TensorVariable, TensorVariable]:
    """E[d | x] and Cov[d | x]; noise inside a function is linearised at zero (Eq. 4.4)."""
    if system.gaussian_observation:
        return observation_moments(system, symbols)
    means, variances = zip(*map(_moments_of, _distributions(system, symbols)), strict=True)
    return pt.stack(means), pt.diag(pt.stack(variances))


def unknown_moments(system: StateSpaceModel) -> list[str]:
    """Distributions of the observables whose moments are not in the table, by name."""
    variables = _distributions(system, symbols_of(system))
    return [str(v.owner.op) for v in variables if type(v.owner.op) not in SCALAR_LAWS]


def _moments_of(variable: TensorVariable) -> tuple[TensorVariable, TensorVariable]:
    op = variable.owner.op
    parameters = [pt.cast(v, "float64") for v in parameters_of(variable.owner)]
    mean, variance = SCALAR_LAWS[type(op)].moments(*parameters)
    return pt.as_tensor(mean), pt.as_tensor(variance)


def _distributions(
    system: StateSpaceModel, symbols: Mapping[str, TensorVariable]
) -> list[TensorVariable]:
    """The random variables that the user's function returned, one per observable."""
    graph = system.equations.observation_draw
    assert graph is not None
    generators = [variable.type() for variable in graph.inputs[len(SYMBOLS) :]]
    given = symbols_of(system) | dict(symbols)
    (draw,) = graph.bind([*(given[name] for name in SYMBOLS), *generators])
    return [_without_cast(variable) for variable in draw.owner.inputs]


def _without_cast(variable: TensorVariable) -> TensorVariable:
    """The random variable in a stack of numbers of one type."""
    while isinstance(variable.owner.op, Elemwise) and isinstance(
        variable.owner.op.scalar_op, ps.Cast
    ):
        (variable,) = variable.owner.inputs
    return variable
