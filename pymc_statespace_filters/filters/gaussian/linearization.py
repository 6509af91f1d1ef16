"""Graphs of a system linearised around the mean of a Gaussian state.

Used by the extended Kalman filter and its smoother. The state of the filter is one vector: the
mean, then the lower triangle of the covariance.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pytensor.tensor as pt
from pytensor.tensor.linalg import cholesky, solve_triangular
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.lowering.gaussian import without_missing
from pymc_statespace_filters.compiler.lowering.symbols import call, jacobian_of, observation_moments
from pymc_statespace_filters.system.model import StateSpaceModel

Symbols = Mapping[str, TensorVariable]


def state_size(n: int) -> int:
    """Length of the vector (mean, lower triangle of the covariance) for n states."""
    return n + n * (n + 1) // 2


def pack(mean: TensorVariable, cov: TensorVariable) -> TensorVariable:
    """Concatenate a vector and the lower triangle of a symmetric matrix."""
    rows, columns = np.tril_indices(mean.type.shape[0])
    return pt.concatenate([mean, cov[rows, columns]])


def unpack(s: TensorVariable, n: int) -> tuple[TensorVariable, TensorVariable]:
    """The vector (n,) and the matrix (n, n): the inverse of `pack`."""
    position = np.zeros((n, n), dtype="int64")
    position[np.tril_indices(n)] = np.arange(n * (n + 1) // 2)
    position = np.maximum(position, position.T)
    return s[:n], s[n:][position]


class LinearizedTransition(NamedTuple):
    """One linearised step: x' = mean + A (x - previous mean) + B q (Eq. 4.9)."""

    mean: TensorVariable
    state_jac: TensorVariable
    noise_jac: TensorVariable


class Innovation(NamedTuple):
    """One linearised observation: residual = C (x - mean) + e, e ~ N(0, noise_cov).

    ``chol`` is the lower factor of ``innovation_cov``, ``gain`` the Kalman gain K and
    ``update_jac`` is I - K C. Rows of C are zero for missing components.
    """

    residual: TensorVariable
    observed: TensorVariable
    observation_jac: TensorVariable
    noise_cov: TensorVariable
    innovation_cov: TensorVariable
    chol: TensorVariable
    gain: TensorVariable
    update_jac: TensorVariable


def linearize_transition(
    system: StateSpaceModel, values: Symbols, mean: TensorVariable
) -> LinearizedTransition:
    """Eqs. 4.8-4.10, at the mean before the step."""
    q = pt.zeros((system.m,))
    forecast = call(system.equations.transition, system, {**values, "x": mean, "q": q})
    return LinearizedTransition(forecast, jacobian_of(forecast, mean), jacobian_of(forecast, q))


def innovation_moments(
    system: StateSpaceModel, values: Symbols, mean: TensorVariable, cov: TensorVariable
) -> Innovation:
    """Eqs. 4.3-4.7, at the mean of the forecast."""
    expected, noise_cov = observation_moments(system, {**values, "x": mean})
    observation_jac = jacobian_of(expected, mean)
    residual, noise_cov, observed = without_missing(values["d"], expected, noise_cov)
    observation_jac = observation_jac * observed[:, None]
    innovation_cov = observation_jac @ cov @ observation_jac.T + noise_cov
    chol = cholesky(innovation_cov, lower=True)
    # K = P C^T S^-1 by two triangular solves.
    half = solve_triangular(chol, observation_jac @ cov, lower=True, b_ndim=2)
    gain = solve_triangular(chol.T, half, lower=False, b_ndim=2).T
    update_jac = pt.eye(system.n) - gain @ observation_jac
    return Innovation(
        residual, observed, observation_jac, noise_cov, innovation_cov, chol, gain, update_jac
    )
