"""What all Gaussian filters share: everything but their linearisation and the systems they take."""

from functools import lru_cache
from typing import ClassVar

import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from ...compiler.codegen.function_types import Graph
from ...compiler.lowering.symbols import symbols_of
from ...compiler.native.entry_point import EntryPoint
from ...compiler.native.plan import Plan
from ...compiler.native.planned_function import PlannedFunction
from ...errors import ModelError
from ...system.model import StateSpaceModel
from .. import functions
from ..protocol import System
from . import deterministic
from .backward import BACKWARD
from .forward import FORWARD
from .functions import filter_plan
from .linearization import Linearization, Linearizations, predict, start, state_size, update
from .recursion import GaussianFilterFunctions
from .states import RUN, states_plan
from .tangent import linearizations_of


class GaussianFilterBase:
    """Compiles a filter from its ``linearization``."""

    noisy: ClassVar[bool] = False
    has_gradient: ClassVar[bool] = True
    resumes: ClassVar[bool] = True

    @property
    def linearization(self) -> Linearization:
        """How the filter linearises a system."""
        raise NotImplementedError

    def is_exact_for(self, system: System) -> bool:
        """Whether the system is linear, or deterministic; False where that cannot be decided."""
        return system.is_linear or (
            system.is_deterministic and system.has_exact_observation_density
        )

    def compile(self, system: System) -> PlannedFunction:
        """Compile the log-likelihood."""
        return functions.likelihood(self._plan(system, FORWARD))

    def compile_batch(self, system: System) -> PlannedFunction:
        """Compile the likelihood of many points: theta (B, k) -> terms (B, J), health (B, 3)."""
        return functions.of_points(self._plan(system, FORWARD, of_many=True))

    def compile_taped(self, system: System) -> PlannedFunction:
        """Compile the forward pass, with a third result: the tape."""
        return functions.taped(self._plan(system, FORWARD, leaves_tape=True))

    def compile_pullback(self, system: System) -> PlannedFunction:
        """Compile the backward pass along the tape."""
        return functions.pullback(self._plan(system, BACKWARD))

    def compile_gradient(self, system: System) -> PlannedFunction:
        """Compile both passes as one function."""
        return functions.gradient(self._plan(system, BACKWARD, leaves_tape=True))

    def compile_panel(self, system: System) -> PlannedFunction:
        """Compile the likelihood of a panel: theta (G, k), rows (J, 3) -> terms (J,), health."""
        return functions.of_panel(self._plan(system, FORWARD, of_many=True))

    def compile_panel_taped(self, system: System) -> PlannedFunction:
        """Compile the forward pass of a panel, with a third result: the tape."""
        plan = self._plan(system, FORWARD, of_many=True, leaves_tape=True)
        return functions.taped(plan, of_panel=True)

    def compile_panel_pullback(self, system: System) -> PlannedFunction:
        """Compile the backward pass of a panel along the tape."""
        return functions.pullback(self._plan(system, BACKWARD, of_many=True), of_panel=True)

    def compile_panel_gradient(self, system: System) -> PlannedFunction:
        """Compile both passes of a panel as one function."""
        plan = self._plan(system, BACKWARD, of_many=True, leaves_tape=True)
        return functions.gradient(plan, of_panel=True)

    def compile_states(self, system: System, moment: str) -> PlannedFunction:
        """Compile "predicted", "filtered" or "smoothed" states; smoothed draws are paths."""
        if system.is_deterministic:
            return functions.states(self._plan(system, RUN))
        recursion = self._functions(system)
        return functions.states(
            states_plan(system, recursion, self._linearizations(system), moment)
        )

    def compile_run(self, system: System) -> PlannedFunction:
        """Compile one run with all that it computes."""
        return functions.run(self._plan(system, RUN))

    def _plan(
        self, system: System, run: EntryPoint, *, of_many: bool = False, leaves_tape: bool = False
    ) -> Plan:
        return filter_plan(
            system, self._functions(system), run, of_many=of_many, leaves_tape=leaves_tape,
            goes_back=run is BACKWARD,
        )  # fmt: skip

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""
        return "modified Bryson-Frazier"

    def _functions(self, system: System) -> GaussianFilterFunctions:
        if system.is_deterministic:
            return _of_deterministic(system.model.gaussian)
        return _functions(self._linearizations(system), system.model.gaussian)

    def _linearizations(self, system: System) -> Linearizations:
        return linearizations_of(system.model.gaussian, self.linearization)

    def _check_gaussian(self, system: System) -> None:
        """Raise if the observation of an uncertain state is not Gaussian."""
        if not (system.gaussian_observation or system.is_deterministic):
            raise ModelError(
                f"{type(self).__name__} needs an observation function with Gaussian noise, got "
                f"observation_dist or observation_logp"
            )

    def _check_not_carried(self, system: System) -> None:
        """Raise if an update would move a carried state."""
        if system.carried and not system.is_deterministic:
            raise ModelError(
                f"{type(self).__name__} cannot treat the carried states {list(system.carried)}, "
                f"which no Kalman update may move"
            )


_of_deterministic = lru_cache(maxsize=256)(deterministic.filter_functions)


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
