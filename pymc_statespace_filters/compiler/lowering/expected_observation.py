"""The observation of a state without noise."""

from collections.abc import Mapping

import pytensor.tensor as pt
from pymc.distributions.moments import mean
from pymc.exceptions import UndefinedMomentException
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.tensor.elemwise import Elemwise
from pytensor.tensor.variable import TensorVariable

from ...errors import ModelError
from ...system.model import StateSpaceModel
from .symbols import SYMBOLS, call, symbols_of


def expected_observation(
    system: StateSpaceModel, given: Mapping[str, TensorVariable]
) -> TensorVariable:
    """``h(x, e = 0)`` of an observation function, or the means of the user's distributions."""
    if (draw := system.equations.observation_draw) is not None:
        return _means(system, draw, given)
    return call(system.equations.observation, system, given)


def _means(
    system: StateSpaceModel, draw: FrozenFunctionGraph, given: Mapping[str, TensorVariable]
) -> TensorVariable:
    symbols = symbols_of(system) | dict(given)
    core = [symbols[name] for name in SYMBOLS]
    generators = [variable.type() for variable in draw.inputs[len(core) :]]
    (drawn,) = draw.bind([*core, *generators])
    # `_trace_distributions` stacks the distributions, those of integers behind a cast.
    means = [_mean(_before_cast(entry)) for entry in drawn.owner.inputs]
    return pt.stack([pt.cast(value, "float64") for value in means])


def _before_cast(entry: TensorVariable) -> TensorVariable:
    return entry.owner.inputs[0] if isinstance(entry.owner.op, Elemwise) else entry


def _mean(variable: TensorVariable) -> TensorVariable:
    try:
        return mean(variable)
    except (NotImplementedError, UndefinedMomentException) as error:
        raise ModelError(
            "noise=False needs the mean of every distribution in observation_dist, got "
            f"{variable.owner.op}, of which PyMC gives none; use noise=True"
        ) from error
