"""The extended Kalman filter, thesis Eqs. 4.3-4.14, and its exact reverse-mode derivative.

The two verbs are written once, as graphs; their derivatives come from the same graphs. The state
of the filter is one vector: the mean, then the lower triangle of the covariance.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.tensor.linalg import cholesky, solve_triangular
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters._failures import (
    COVARIANCE_NOT_POSITIVE,
    NO_FINITE_MEMBER,
    NONE,
)
from pymc_statespace_filters.lowering import (
    Compiled,
    Graph,
    VectorFunction,
    call,
    covariance_check,
    is_linear,
    jacobian_of,
    jit,
    key_of,
    log_normal,
    observation_moments,
    symbols_of,
    vector_functions,
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
        parts = vector_functions(_forward(system))
        start, predict, update = (part.function for part in parts.values())
        valid = covariance_check(system)
        has_valid_covariances, dt, n = valid.function, system.dt, system.n

        def log_likelihood(theta, steps, observed, inputs, t0, seed):
            terms = np.full(steps.size, -np.inf)
            health = np.array([np.inf, float(NONE), -1.0])
            if not has_valid_covariances(theta):
                health[1], health[2] = COVARIANCE_NOT_POSITIVE, 0.0
                return terms, health
            s = start(theta)
            k = 0
            for j in range(steps.size):
                while k < steps[j]:
                    s = predict(theta, inputs, k, t0 + k * dt, s)
                    k += 1
                if np.isnan(observed[j]).all():
                    terms[j] = 0.0
                    continue
                finite = np.isfinite(s[0])
                for i in range(n):
                    finite &= np.isfinite(s[i])
                s, terms[j] = update(theta, inputs, k, t0 + k * dt, observed[j], s)
                if not np.isfinite(terms[j]):
                    terms[j:] = -np.inf
                    health[1] = COVARIANCE_NOT_POSITIVE if finite else NO_FINITE_MEMBER
                    health[2] = j
                    break
            return terms, health

        return _compiled(log_likelihood, parts | {"valid": valid}, system)

    def compile_gradient(self, system: StateSpaceModel) -> Compiled:
        """The function (theta, steps, observed, inputs, t0, seed, terms_bar) -> theta_bar."""
        parts = vector_functions(_forward(system) | _reverse(system))
        start, predict, update, zeros, start_vjp, predict_vjp, update_vjp = (
            part.function for part in parts.values()
        )
        save = _save(system)
        dt, size = system.dt, _state_size(system.n)

        def gradient(theta, steps, observed, inputs, t0, seed, terms_bar):
            n_steps = steps[-1] + 1 if steps.size else 1
            before = np.empty((n_steps, size))  # the state that each step starts from
            forecasts = np.empty((steps.size, size))  # the state that each observation meets
            s = start(theta)
            k = 0
            for j in range(steps.size):
                while k < steps[j]:
                    save(before, k, s)
                    s = predict(theta, inputs, k, t0 + k * dt, s)
                    k += 1
                save(forecasts, j, s)
                if not np.isnan(observed[j]).all():
                    s, term = update(theta, inputs, k, t0 + k * dt, observed[j], s)
                    if not np.isfinite(term):
                        return np.zeros(theta.size)
            s_bar, c_bar = zeros(theta)
            for j in range(steps.size - 1, -1, -1):
                if not np.isnan(observed[j]).all():
                    s_bar, c_bar = update_vjp(
                        theta, inputs, k, t0 + k * dt, observed[j], forecasts[j], s_bar,
                        terms_bar[j], c_bar,
                    )  # fmt: skip
                first = steps[j - 1] if j else 0
                while k > first:
                    k -= 1
                    s_bar, c_bar = predict_vjp(
                        theta, inputs, k, t0 + k * dt, before[k], s_bar, c_bar
                    )
            c_bar = start_vjp(theta, s_bar, c_bar)
            theta_bar = np.empty(theta.size)
            for i in range(theta.size):
                theta_bar[i] = c_bar[i]
            return theta_bar

        return _compiled(gradient, parts, system)


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


def _symbols(system: StateSpaceModel) -> dict[str, TensorVariable]:
    size = _state_size(system.n)
    return symbols_of(system) | {
        "s": pt.tensor("s", shape=(size,), dtype="float64"),
        "s_bar": pt.tensor("s_bar", shape=(size,), dtype="float64"),
        "c_bar": pt.tensor("c_bar", shape=(system.n_theta,), dtype="float64"),
        "term_bar": pt.tensor("term_bar", shape=(), dtype="float64"),
    }


_PREDICT = ("theta", "u", "t", "s")
_UPDATE = ("theta", "u", "t", "d", "s")


def _forward(system: StateSpaceModel) -> dict[str, VectorFunction]:
    values = _symbols(system)

    def function(arguments: str, inputs: tuple[str, ...], outputs: list, *scalar: bool):
        return VectorFunction(arguments, Graph({i: values[i] for i in inputs}, outputs), scalar)

    analysis, term = _update(system, values)
    return {
        "start": function("c", ("theta",), [_start(system, values)], False),
        "predict": function("c, inputs, k, t, s", _PREDICT, [_predict(system, values)], False),
        "update": function(
            "c, inputs, k, t, d, s", _UPDATE, [analysis, pt.atleast_1d(term)], False, True
        ),
    }


def _reverse(system: StateSpaceModel) -> dict[str, VectorFunction]:
    """Vector-Jacobian products of the three parts; each adds to ``c_bar``, theta's cotangent."""
    values = _symbols(system)
    theta, s, s_bar, c_bar = (values[name] for name in ("theta", "s", "s_bar", "c_bar"))

    def function(arguments: str, inputs: tuple[str, ...], outputs: list):
        graph = Graph({i: values[i] for i in inputs}, outputs)
        return VectorFunction(arguments, graph, [False] * len(outputs))

    def pull(outputs: list, cotangents: list, wrt: list) -> list[TensorVariable]:
        bars = pytensor.grad(
            None,
            wrt,
            known_grads=dict(zip(outputs, cotangents, strict=True)),
            disconnected_inputs="ignore",
            return_disconnected="zero",
        )
        return [pt.specify_shape(b, w.type.shape) for b, w in zip(bars, wrt, strict=True)]

    (start_bar,) = pull([_start(system, values)], [s_bar], [theta])
    state_bar, theta_bar = pull([_predict(system, values)], [s_bar], [s, theta])
    forecast_bar, datum_bar = pull(
        [*_update(system, values)], [s_bar, values["term_bar"]], [s, theta]
    )
    return {
        "zeros": function("c", ("theta",), [pt.zeros(n.type.shape) for n in (s, theta)]),
        "start_vjp": function("c, s_bar, c_bar", ("theta", "s_bar", "c_bar"), [c_bar + start_bar]),
        "predict_vjp": function(
            "c, inputs, k, t, s, s_bar, c_bar",
            (*_PREDICT, "s_bar", "c_bar"),
            [state_bar, c_bar + theta_bar],
        ),
        "update_vjp": function(
            "c, inputs, k, t, d, s, s_bar, term_bar, c_bar",
            (*_UPDATE, "s_bar", "term_bar", "c_bar"),
            [forecast_bar, c_bar + datum_bar],
        ),
    }


def _save(system: StateSpaceModel) -> Any:
    """``save(table, row, s)``; s is a tuple of numbers or an array."""
    size = _state_size(system.n)

    @jit
    def save(table, row, s):
        for i in range(size):
            table[row, i] = s[i]

    return save


def _compiled(function: Any, parts: Mapping[str, Compiled], system: StateSpaceModel) -> Compiled:
    what = f"{function.__name__} {system.dt!r} {system.n}"
    return Compiled(jit(function), key_of(what, *(part.key for part in parts.values())))
