"""The extended Kalman filter, thesis Eqs. 4.3-4.14, and its exact reverse-mode derivative.

Prediction and update are written once, as graphs; their derivatives come from the same graphs. The
state of the filter is one vector: the mean, then the lower triangle of the covariance.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.codegen.function_types import (
    CompiledFunction,
    Graph,
    VectorFunction,
)
from pymc_statespace_filters.compiler.lowering.gaussian import log_normal
from pymc_statespace_filters.compiler.lowering.symbols import call, process_noise_cov, symbols_of
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.gaussian.adjoint import compile_gradient, compile_pullback
from pymc_statespace_filters.filters.gaussian.batch import compile_batch
from pymc_statespace_filters.filters.gaussian.linearization import (
    Symbols,
    innovation_moments,
    linearize_transition,
    pack,
    state_size,
    unpack,
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


@dataclass(frozen=True)
class EKF:
    """Extended Kalman filter: exact for linear systems with Gaussian noise, else an approximation.

    The state is approximated as Gaussian between observations, and the equations as linear around
    its mean. The filter is deterministic and has a gradient, so gradient samplers such as NUTS
    work with it. Where the state has several modes between sparse observations, the likelihood is
    wrong by tens of nats; compare with a particle filter before trusting it.

    Notes
    -----
    Thesis, Eqs. 4.3-4.14. Differences: the forecast starts from the analysis of the step before
    (the thesis prints: from its forecast); the noise of the observation enters the innovation
    covariance;
    the analysis covariance has Joseph's form, which stays symmetric and non-negative.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.EKF()
    EKF()
    """

    noisy: ClassVar[bool] = False
    has_gradient: ClassVar[bool] = True

    def check(self, system: System) -> None:
        """Raise if the observation is not Gaussian or a state is carried."""
        if not system.gaussian_observation:
            raise ModelError(
                "EKF needs an observation function with Gaussian noise; observation_dist and "
                "observation_logp work with the particle filters BootstrapPF and PFEnKF"
            )
        if system.carried:
            raise ModelError(
                f"EKF cannot treat the carried states {list(system.carried)}, which no Kalman "
                f"update may move; use EnKF, BootstrapPF or PFEnKF"
            )

    def is_exact_for(self, system: System) -> bool:
        """Whether the system is linear; False too where that cannot be decided."""
        return system.is_linear

    def compile(self, system: System) -> CompiledFunction[LogLikelihoodFunction]:
        """Compile the log-likelihood."""
        return compile_value(_functions(system.model))

    def compile_batch(self, system: System) -> CompiledFunction:
        """Compile the likelihood of many points: theta (B, k) -> terms (B, J), health (B, 3)."""
        return compile_batch(_functions(system.model))

    def compile_taped(self, system: System) -> CompiledFunction:
        """Compile the forward pass, with a third result: the tape."""
        return compile_taped(_functions(system.model))

    def compile_pullback(self, system: System) -> CompiledFunction:
        """Compile the backward pass along the tape."""
        return compile_pullback(_functions(system.model))

    def compile_gradient(self, system: System) -> CompiledFunction[GradientFunction]:
        """Compile both passes as one function."""
        return compile_gradient(_functions(system.model))

    def compile_states(self, system: System, moment: str) -> CompiledFunction[StatesFunction]:
        """Compile "predicted", "filtered" or "smoothed" states; smoothed draws are paths."""
        return compile_states(_forward_pass(system.model), moment)

    def compile_run(self, system: System) -> CompiledFunction[RunFunction]:
        """Compile one run with all that it computes."""
        return compile_run(_functions(system.model))

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""
        return "modified Bryson-Frazier"


def _start(system: StateSpaceModel, values: Symbols) -> TensorVariable:
    mean = call(system.equations.initial_mean, system, values)
    return pack(mean, call(system.equations.initial_cov, system, values))


def _predict(system: StateSpaceModel, values: Symbols) -> TensorVariable:
    """Eqs. 4.8-4.11: A and B are taken at the analysis of this step."""
    mean, cov = unpack(values["s"], system.n)
    transition = linearize_transition(system, values, mean)
    forecast_cov = transition.state_jac @ cov @ transition.state_jac.T
    if system.m:
        forecast_cov += process_noise_cov(system, values, transition.noise_jac)
    return pack(transition.mean, forecast_cov)


def _update(system: StateSpaceModel, values: Symbols) -> tuple[TensorVariable, TensorVariable]:
    """Eqs. 4.3-4.7 and 4.14: the analysis, and log p(d_j | d_1 .. d_{j-1})."""
    mean, cov = unpack(values["s"], system.n)
    innovation = innovation_moments(system, values, mean, cov)
    gain, update_jac = innovation.gain, innovation.update_jac
    analysis_cov = update_jac @ cov @ update_jac.T + gain @ innovation.noise_cov @ gain.T
    increment = log_normal(innovation.residual, innovation.innovation_cov, innovation.observed)
    return pack(mean + gain @ innovation.residual, analysis_cov), increment


def _functions(system: StateSpaceModel) -> GaussianFilterFunctions:
    """The three functions of the filter, each of theta and the state of the filter ``s``."""
    s = pt.tensor("s", shape=(state_size(system.n),), dtype="float64")
    values = symbols_of(system) | {"s": s}

    def function(arguments: str, inputs: str, outputs: list, *scalar: bool):
        graph = Graph({i: values[i] for i in inputs.split()}, outputs)
        return VectorFunction(arguments, graph, scalar)

    analysis, term = _update(system, values)
    return GaussianFilterFunctions(
        system,
        function("c", "theta", [_start(system, values)], False),
        function("c, inputs, k, t, s", "theta u t s", [_predict(system, values)], False),
        function(
            "c, inputs, k, t, d, s",
            "theta u t d s",
            [analysis, pt.atleast_1d(term)],
            False,
            True,
        ),
    )


@lru_cache(maxsize=256)
def _forward_pass(system: StateSpaceModel) -> ForwardPass:
    return forward_pass(_functions(system))
