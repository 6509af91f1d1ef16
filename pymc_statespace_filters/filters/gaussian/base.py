"""What all Gaussian filters share: everything but their linearisation and the systems they take."""

from functools import lru_cache
from typing import ClassVar

import pytensor.tensor as pt

from pymc_statespace_filters.compiler.codegen.function_types import (
    CompiledFunction,
    Graph,
    VectorFunction,
)
from pymc_statespace_filters.compiler.lowering.symbols import symbols_of
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.gaussian import deterministic
from pymc_statespace_filters.filters.gaussian.adjoint import compile_gradient, compile_pullback
from pymc_statespace_filters.filters.gaussian.batch import compile_batch
from pymc_statespace_filters.filters.gaussian.linearization import (
    Linearization,
    predict,
    start,
    state_size,
    update,
)
from pymc_statespace_filters.filters.gaussian.panel import (
    compile_panel,
    compile_panel_gradient,
    compile_panel_pullback,
    compile_panel_taped,
)
from pymc_statespace_filters.filters.gaussian.recursion import (
    GaussianFilterFunctions,
    compile_taped,
    compile_value,
)
from pymc_statespace_filters.filters.gaussian.states import (
    ForwardPass,
    compile_run,
    compile_states,
    forward_pass,
)
from pymc_statespace_filters.filters.protocol import (
    GradientFunction,
    LogLikelihoodFunction,
    RunFunction,
    StatesFunction,
    System,
)
from pymc_statespace_filters.system.model import StateSpaceModel


class GaussianFilterBase:
    """Compiles a filter from its ``linearization``."""

    noisy: ClassVar[bool] = False
    has_gradient: ClassVar[bool] = True

    @property
    def linearization(self) -> Linearization:
        """How the filter linearises a system."""
        raise NotImplementedError

    def is_exact_for(self, system: System) -> bool:
        """Whether the system is linear, or deterministic; False where that cannot be decided."""
        return system.is_linear or (
            system.is_deterministic and system.has_exact_observation_density
        )

    def compile(self, system: System) -> CompiledFunction[LogLikelihoodFunction]:
        """Compile the log-likelihood."""
        return system.at_parameters(compile_value(self._functions(system)))

    def compile_batch(self, system: System) -> CompiledFunction:
        """Compile the likelihood of many points: theta (B, k) -> terms (B, J), health (B, 3)."""
        return system.at_parameters(compile_batch(self._functions(system)), of_many=True)

    def compile_taped(self, system: System) -> CompiledFunction:
        """Compile the forward pass, with a third result: the tape."""
        return system.at_parameters(compile_taped(self._functions(system)))

    def compile_pullback(self, system: System) -> CompiledFunction:
        """Compile the backward pass along the tape."""
        return system.derivative_at_parameters(compile_pullback(self._functions(system)))

    def compile_gradient(self, system: System) -> CompiledFunction[GradientFunction]:
        """Compile both passes as one function."""
        return system.derivative_at_parameters(compile_gradient(self._functions(system)))

    def compile_panel(self, system: System) -> CompiledFunction:
        """Compile the likelihood of a panel: theta (G, k), rows (J, 3) -> terms (J,), health."""
        return system.at_parameters(compile_panel(self._functions(system)), of_many=True)

    def compile_panel_taped(self, system: System) -> CompiledFunction:
        """Compile the forward pass of a panel, with a third result: the tape."""
        return system.at_parameters(compile_panel_taped(self._functions(system)), of_many=True)

    def compile_panel_pullback(self, system: System) -> CompiledFunction:
        """Compile the backward pass of a panel along the tape."""
        reverse = compile_panel_pullback(self._functions(system))
        return system.derivative_at_parameters(reverse, of_many=True)

    def compile_panel_gradient(self, system: System) -> CompiledFunction:
        """Compile both passes of a panel as one function."""
        gradient = compile_panel_gradient(self._functions(system))
        return system.derivative_at_parameters(gradient, of_many=True)

    def compile_states(self, system: System, moment: str) -> CompiledFunction[StatesFunction]:
        """Compile "predicted", "filtered" or "smoothed" states; smoothed draws are paths."""
        if system.is_deterministic:
            states = deterministic.compile_states(self._functions(system))
        else:
            forward = _forward_pass(self.linearization, system.model.gaussian)
            states = compile_states(forward, moment)
        return system.at_parameters(states)

    def compile_run(self, system: System) -> CompiledFunction[RunFunction]:
        """Compile one run with all that it computes."""
        compile = deterministic.compile_run if system.is_deterministic else compile_run
        return system.at_parameters(compile(self._functions(system)))

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""
        return "modified Bryson-Frazier"

    def _functions(self, system: System) -> GaussianFilterFunctions:
        if system.is_deterministic:
            return _of_deterministic(system.model.gaussian)
        return _functions(self.linearization, system.model.gaussian)

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
def _functions(linearization: Linearization, system: StateSpaceModel) -> GaussianFilterFunctions:
    """The three functions of the filter, each of theta and the state of the filter ``s``."""
    s = pt.tensor("s", shape=(state_size(system.n),), dtype="float64")
    values = symbols_of(system) | {"s": s}

    def function(arguments: str, inputs: str, outputs: list, *scalar: bool):
        graph = Graph({i: values[i] for i in inputs.split()}, outputs)
        return VectorFunction(arguments, graph, scalar)

    analysis, term = update(linearization, system, values)
    forecast = predict(linearization, system, values)
    return GaussianFilterFunctions(
        system,
        linearization.has_short_rows,
        function("c", "theta", [start(system, values)], False),
        function("c, inputs, k, t, s", "theta u t s", [forecast], False),
        function(
            "c, inputs, k, t, d, s",
            "theta u t d s",
            [analysis, pt.atleast_1d(term)],
            False,
            True,
        ),
    )


@lru_cache(maxsize=256)
def _forward_pass(linearization: Linearization, system: StateSpaceModel) -> ForwardPass:
    return forward_pass(_functions(linearization, system), linearization)
