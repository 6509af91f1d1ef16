"""The extended Kalman filter, thesis Eqs. 4.3-4.14, and its exact reverse-mode derivative.

The two verbs are written once, as graphs; their derivatives come from the same graphs. The state
of the filter is one vector: the mean, then the lower triangle of the covariance.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytensor.tensor as pt
from pytensor.tensor.linalg import cholesky, solve_triangular
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters._batch import compile_batch
from pymc_statespace_filters.filters._recursion import Recursion, compile_taped, compile_value
from pymc_statespace_filters.filters._reverse import compile_gradient, compile_reverse
from pymc_statespace_filters.lowering import (
    Compiled,
    Graph,
    VectorFunction,
    call,
    is_linear,
    jacobian_of,
    log_normal,
    observation_moments,
    symbols_of,
    without_missing,
)
from pymc_statespace_filters.model import StateSpaceModel


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

    def compile(self, system: StateSpaceModel) -> Compiled:
        """The function (theta, steps, observed, inputs, t0, seed) -> (terms, health)."""
        return compile_value(_recursion(system))

    def compile_batch(self, system: StateSpaceModel) -> Compiled:
        """The same of many points: theta (B, k) -> terms (B, J) and health (B, 3)."""
        return compile_batch(_recursion(system))

    def compile_taped(self, system: StateSpaceModel) -> Compiled:
        """That of one point with a third result: the tape, which `compile_reverse` reads."""
        return compile_taped(_recursion(system))

    def compile_reverse(self, system: StateSpaceModel) -> Compiled:
        """The function (theta, steps, observed, inputs, t0, seed, tape, terms_bar) -> theta_bar."""
        return compile_reverse(_recursion(system))

    def compile_gradient(self, system: StateSpaceModel) -> Compiled:
        """The function (theta, steps, observed, inputs, t0, seed, terms_bar) -> theta_bar."""
        return compile_gradient(_recursion(system))


def _state_size(n: int) -> int:
    return n + n * (n + 1) // 2


def _pack(mean: TensorVariable, cov: TensorVariable) -> TensorVariable:
    rows, columns = np.tril_indices(mean.type.shape[0])
    return pt.concatenate([mean, cov[rows, columns]])


def _unpack(s: TensorVariable, n: int) -> tuple[TensorVariable, TensorVariable]:
    where = np.zeros((n, n), dtype="int64")
    where[np.tril_indices(n)] = np.arange(n * (n + 1) // 2)
    where = np.maximum(where, where.T)
    return s[:n], s[n:][where]


Symbols = Mapping[str, TensorVariable]


def _start(system: StateSpaceModel, values: Symbols) -> TensorVariable:
    mean = call(system.equations.initial_mean, system, values)
    return _pack(mean, call(system.equations.initial_cov, system, values))


def _predict(system: StateSpaceModel, values: Symbols) -> TensorVariable:
    """Eqs. 4.8-4.11: A and B are taken at the analysis of this step."""
    mean, cov = _unpack(values["s"], system.n)
    q = pt.zeros((system.m,))
    at = {**values, "x": mean, "q": q}
    forecast = call(system.equations.transition, system, at)
    state_jac, noise_jac = jacobian_of(forecast, mean), jacobian_of(forecast, q)
    forecast_cov = state_jac @ cov @ state_jac.T
    if system.m:
        if system.equations.process_noise is not None:
            noise_cov = call(system.equations.process_noise, system, values)
            forecast_cov += noise_jac @ noise_cov @ noise_jac.T
        else:
            forecast_cov += noise_jac @ noise_jac.T
    return _pack(forecast, forecast_cov)


def _update(system: StateSpaceModel, values: Symbols) -> tuple[TensorVariable, TensorVariable]:
    """Eqs. 4.3-4.7 and 4.14: the analysis, and log p(d_j | d_1 .. d_{j-1})."""
    mean, cov = _unpack(values["s"], system.n)
    expected, noise_cov = observation_moments(system, {**values, "x": mean})
    seen_jac = jacobian_of(expected, mean)
    residual, noise_cov, seen = without_missing(values["d"], expected, noise_cov)
    seen_jac = seen_jac * seen[:, None]
    innovation_cov = seen_jac @ cov @ seen_jac.T + noise_cov
    chol = cholesky(innovation_cov, lower=True)
    # K = P C^T S^-1 by two triangular solves.
    half = solve_triangular(chol, seen_jac @ cov, lower=True, b_ndim=2)
    gain = solve_triangular(chol.T, half, lower=False, b_ndim=2).T
    kept = pt.eye(system.n) - gain @ seen_jac
    analysis_cov = kept @ cov @ kept.T + gain @ noise_cov @ gain.T
    increment = log_normal(residual, innovation_cov, seen)
    return _pack(mean + gain @ residual, analysis_cov), increment


def _recursion(system: StateSpaceModel) -> Recursion:
    """The three functions of the filter, each of theta and the state of the filter ``s``."""
    s = pt.tensor("s", shape=(_state_size(system.n),), dtype="float64")
    values = symbols_of(system) | {"s": s}

    def function(arguments: str, inputs: str, outputs: list, *scalar: bool):
        graph = Graph({i: values[i] for i in inputs.split()}, outputs)
        return VectorFunction(arguments, graph, scalar)

    analysis, term = _update(system, values)
    return Recursion(
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
