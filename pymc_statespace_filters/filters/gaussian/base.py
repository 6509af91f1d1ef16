"""What all Gaussian filters share: everything but their linearisation and the systems they take."""

from collections.abc import Sequence
from functools import lru_cache
from typing import ClassVar

import numpy as np
import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from ...compiler.codegen.function_types import Graph
from ...compiler.lowering.observation import observation_log_density
from ...compiler.lowering.symbols import call, symbols_of
from ...compiler.native.entry_point import EntryPoint
from ...compiler.native.plan import Plan
from ...errors import ModelError
from ...system.model import StateSpaceModel
from ..protocol import System, check_sensor_has_noise
from ..state_law import StateLaw, law_of_moments
from ..taped import TapedFilter
from .backward import BACKWARD
from .forward import FORWARD
from .functions import GaussianFilterFunctions, filter_plan
from .linearization import (
    Linearization,
    Linearizations,
    linearizations_of,
    predict,
    start,
    state_size,
    update,
)
from .states import RUN as RUN_STATES
from .states import states_plan


class GaussianFilterBase(TapedFilter):
    """Compiles a filter from its ``linearization``."""

    resumes_many: ClassVar[bool] = True

    @property
    def linearization(self) -> Linearization:
        """How the filter linearises a system."""
        raise NotImplementedError

    def is_exact_for(self, system: System) -> bool:
        """Whether the system is linear, or deterministic; False where that cannot be decided."""
        return system.is_linear or (
            system.is_deterministic and system.has_exact_observation_density
        )

    def linearised(self, system: System) -> System:
        """The system that is linearised: all of it."""
        return system

    def is_smooth_for(self, system: System) -> bool:
        """Whether the likelihood has no kinks or jumps along a parameter; False if unknown."""
        return system.is_smooth

    def plan_of_pass(
        self,
        system: System,
        *,
        of_many: bool = False,
        leaves_tape: bool = False,
        goes_back: bool = False,
    ) -> Plan:
        """Plan a pass along a record; one that leaves a tape and goes back is the gradient."""
        runs = BACKWARD if goes_back else FORWARD
        return self._plan(system, runs, of_many=of_many, leaves_tape=leaves_tape)

    def plan_of_states(self, system: System, moment: str) -> Plan:
        """Plan "predicted", "filtered" or "smoothed" states; smoothed draws are paths."""
        if system.is_deterministic:
            return self.plan_of_run(system)
        recursion = self._functions(system)
        return states_plan(system, recursion, self._linearizations(system), moment)

    def plan_of_run(self, system: System) -> Plan:
        """Plan one run with all that it computes."""
        return self._plan(system, (RUN_STATES,))

    def law_of_state(self, system: System, states: np.ndarray) -> StateLaw:
        """Return the law of the state, from what the filter leaves (m, S) at m points."""
        return law_of_moments(states, system.n)

    def _plan(
        self,
        system: System,
        runs: Sequence[EntryPoint],
        *,
        of_many: bool = False,
        leaves_tape: bool = False,
    ) -> Plan:
        return filter_plan(
            system, self._functions(system), runs, of_many=of_many, leaves_tape=leaves_tape,
            goes_back=runs is BACKWARD,
        )  # fmt: skip

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""
        return "modified Bryson-Frazier"

    def _functions(self, system: System) -> GaussianFilterFunctions:
        if system.is_deterministic:
            return deterministic_functions(system.model.gaussian)
        return _functions(self._linearizations(system), system.model.gaussian)

    def _linearizations(self, system: System) -> Linearizations:
        return linearizations_of(system.model.gaussian, self.linearization)

    def _check_gaussian(self, system: System) -> None:
        """Raise if the observation of an uncertain state is not Gaussian, that of another exact."""
        if system.is_deterministic:
            check_sensor_has_noise(type(self).__name__, system)
        if not (system.has_gaussian_sensor or system.is_deterministic):
            raise ModelError(
                f"{type(self).__name__} needs an observation function with Gaussian noise, got "
                f"observation_dist or observation_logp"
            )

    def _check_no_jumping_parameters(self, system: System) -> None:
        """Raise if a drifting parameter is where an equation jumps, which no data would move."""
        if names := system.jumping_parameters:
            raise ModelError(
                f"{type(self).__name__} cannot follow the drifting {', '.join(names)}, at which "
                "an equation jumps: the observations would not move it. Let it be constant, or use "
                "BootstrapPF"
            )

    def _check_not_carried(self, system: System) -> None:
        """Raise if an update would move a carried state."""
        if system.carried and not system.is_deterministic:
            raise ModelError(
                f"{type(self).__name__} cannot treat the carried states {list(system.carried)}, "
                f"which no Kalman update may move"
            )


@lru_cache(maxsize=256)
def _functions(by: Linearizations, system: StateSpaceModel) -> GaussianFilterFunctions:
    """The three functions of the filter, each of theta and the state of the filter ``s``."""
    s = pt.tensor("s", shape=(state_size(system.n),), dtype="float64")
    values = symbols_of(system) | {"s": s}

    def function(inputs: str, *outputs: TensorVariable) -> Graph:
        return Graph({name: values[name] for name in inputs.split()}, outputs)

    analysis, term = update(by.observation, system, values)
    forecast = predict(by.transition, system, values)
    return GaussianFilterFunctions(
        system,
        by.transition.has_short_rows,
        function("theta", start(system, values)),
        function("theta u t s", forecast),
        function("theta u t d s", analysis, pt.atleast_1d(term)),
    )


@lru_cache(maxsize=256)
def deterministic_functions(system: StateSpaceModel) -> GaussianFilterFunctions:
    """The three functions of a filter for a system without noise whose start is known.

    There is no covariance, so a Gaussian filter is a run of the equations. No observation moves the
    state and each has the density p(d | x), of any kind: the likelihood is exact. The vector ``s``
    of the filter is the state.
    """
    values = symbols_of(system)
    del values["q"]  # zero
    values["s"] = values.pop("x").type("s")
    state = {**values, "x": values["s"]}

    def function(inputs: str, *outputs: TensorVariable) -> Graph:
        return Graph({name: values[name] for name in inputs.split()}, outputs)

    start = call(system.equations.initial_mean, system, values)
    step = call(system.equations.transition, system, state)
    # A copy: the derivative of the term by s would be lost beside s itself as an output.
    seen = [pt.tensor_copy(values["s"]), pt.atleast_1d(observation_log_density(system, state))]
    return GaussianFilterFunctions(
        system,
        # Measured for Runge-Kutta steps: explicit rows take 45 % longer than propagation.
        False,
        function("theta", start),
        function("theta u t s", step),
        function("theta u t d s", *seen),
    )
