"""The extended Kalman filter, thesis Eqs. 4.3-4.14, and its exact reverse-mode derivative.

The two verbs are written once, as graphs; their derivatives come from the same graphs. The state
of the filter is one vector: the mean, then the lower triangle of the covariance.
"""

from dataclasses import dataclass
from functools import lru_cache

import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.codegen.function_types import (
    CompiledFunction,
    Graph,
    VectorFunction,
)
from pymc_statespace_filters.compiler.lowering.gaussian import log_normal
from pymc_statespace_filters.compiler.lowering.structure import is_linear
from pymc_statespace_filters.compiler.lowering.symbols import call, symbols_of
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.gaussian.adjoint import compile_gradient, compile_reverse
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
from pymc_statespace_filters.system.model import StateSpaceModel


@dataclass(frozen=True)
class EKF:
    """Extended Kalman filter: exact for linear systems with Gaussian noise, else an approximation.

    The state between observations is taken for Gaussian, and the equations for linear around
    its mean. Deterministic, with a gradient: gradient samplers such as NUTS work with it. Where
    the state has several modes between sparse observations its likelihood is wrong by tens of
    nats; compare with a particle filter before trusting it.

    Notes
    -----
    Thesis, Eqs. 4.3-4.14. Differences: the forecast starts from the analysis of the step before
    (printed: from its forecast); the noise of the observation enters the innovation covariance;
    the analysis covariance has Joseph's form, which stays symmetric and non-negative.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.EKF()
    EKF()
    """

    noisy = False
    has_gradient = True

    def check(self, system: StateSpaceModel) -> None:
        """Raise if the system is not one that this filter can treat."""
        if not system.gaussian_observation:
            raise ModelError(
                "EKF needs an observation function with Gaussian noise; observation_dist and "
                "observation_logp work with the particle filters BootstrapPF and PFEnKF"
            )
        if system.carried:
            raise ModelError(
                f"EKF cannot treat the carried states {list(system.carried)}, which no Kalman "
                f"update may touch; use EnKF, BootstrapPF or PFEnKF"
            )

    def is_exact_for(self, system: StateSpaceModel) -> bool:
        """Whether the system is linear; False too where that cannot be seen."""
        return is_linear(system)

    def compile(self, system: StateSpaceModel) -> CompiledFunction:
        """The function (theta, steps, observed, inputs, t0, seed) -> (terms, health)."""
        return compile_value(_recursion(system))

    def compile_batch(self, system: StateSpaceModel) -> CompiledFunction:
        """The same of many points: theta (B, k) -> terms (B, J) and health (B, 3)."""
        return compile_batch(_recursion(system))

    def compile_taped(self, system: StateSpaceModel) -> CompiledFunction:
        """That of one point with a third result: the tape, which `compile_reverse` reads."""
        return compile_taped(_recursion(system))

    def compile_reverse(self, system: StateSpaceModel) -> CompiledFunction:
        """The function (theta, steps, observed, inputs, t0, seed, tape, terms_bar) -> theta_bar."""
        return compile_reverse(_recursion(system))

    def compile_gradient(self, system: StateSpaceModel) -> CompiledFunction:
        """The function (theta, steps, observed, inputs, t0, seed, terms_bar) -> theta_bar."""
        return compile_gradient(_recursion(system))

    def compile_states(self, system: StateSpaceModel, moment: str) -> CompiledFunction:
        """The states at some steps, by their mean and standard deviation, and a draw of them.

        The function (theta, steps, observed, inputs, t0, seed, rows, draw_seed) -> (mean (R, n),
        sd (R, n), drawn (R, n), n_effective (R,), health (3,)); ``moment`` is "predicted",
        "filtered" or "smoothed". The draws of one ``draw_seed`` belong together: if smoothed, they
        are a path. See `_bryson_frazier` for how both are made.
        """
        return compile_states(_states_pass(system), moment)

    def compile_run(self, system: StateSpaceModel) -> CompiledFunction:
        """The function (theta, steps, observed, inputs, t0, seed, rows) -> a run.

        See `filters`, the room, for what it returns.
        """
        return compile_run(_recursion(system))

    def smoothing_method(self, system: StateSpaceModel) -> str:
        """What smoothed states are made by."""
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
        if system.equations.process_noise is not None:
            noise_cov = call(system.equations.process_noise, system, values)
            forecast_cov += transition.noise_jac @ noise_cov @ transition.noise_jac.T
        else:
            forecast_cov += transition.noise_jac @ transition.noise_jac.T
    return pack(transition.mean, forecast_cov)


def _update(system: StateSpaceModel, values: Symbols) -> tuple[TensorVariable, TensorVariable]:
    """Eqs. 4.3-4.7 and 4.14: the analysis, and log p(d_j | d_1 .. d_{j-1})."""
    mean, cov = unpack(values["s"], system.n)
    innovation = innovation_moments(system, values, mean, cov)
    gain, update_jac = innovation.gain, innovation.update_jac
    analysis_cov = update_jac @ cov @ update_jac.T + gain @ innovation.noise_cov @ gain.T
    increment = log_normal(innovation.residual, innovation.innovation_cov, innovation.observed)
    return pack(mean + gain @ innovation.residual, analysis_cov), increment


def _recursion(system: StateSpaceModel) -> GaussianFilterFunctions:
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
def _states_pass(system: StateSpaceModel) -> ForwardPass:
    return forward_pass(_recursion(system))
