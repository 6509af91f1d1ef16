"""Linearisation by tangents: that of the EKF, and of all Gaussian filters where it is exact."""

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from ...compiler.lowering.structure import has_linear_observation, has_linear_transition
from ...compiler.lowering.symbols import call, jacobian_of, observation_moments, process_noise_cov
from ...system.model import StateSpaceModel
from .linearization import GaussianState, Linear, Linearization, Linearizations, Seen, Symbols, seen


@dataclass(frozen=True)
class Tangent:
    """Linearisation at the mean of the state, by exact Jacobians."""

    has_short_rows: ClassVar[bool] = True

    def state(self, mean: TensorVariable, cov: TensorVariable) -> GaussianState:
        """The state itself."""
        return GaussianState(mean, None, cov)

    def transition(self, system: StateSpaceModel, values: Symbols, state: GaussianState) -> Linear:
        """Eqs. 4.8-4.10: A and B at the analysis of this step."""
        q = pt.zeros((system.m,))
        forecast = call(system.equations.transition, system, {**values, "x": state.mean, "q": q})
        noise_jac = jacobian_of(forecast, q)
        noise_cov = process_noise_cov(system, values, noise_jac) if system.m else None
        return Linear(forecast, jacobian_of(forecast, state.mean), noise_cov, noise_jac)

    def observation(self, system: StateSpaceModel, values: Symbols, state: GaussianState) -> Seen:
        """Eq. 4.4: C and D at the forecast."""
        expected, noise_cov = observation_moments(system, {**values, "x": state.mean})
        return seen(values["d"], Linear(expected, jacobian_of(expected, state.mean), noise_cov))


@lru_cache(maxsize=256)
def linearizations_of(system: StateSpaceModel, linearization: Linearization) -> Linearizations:
    """Those of transition and observation: the tangent of what is linear, in fewer operations."""
    return Linearizations(
        Tangent() if has_linear_transition(system) else linearization,
        Tangent() if has_linear_observation(system) else linearization,
    )
