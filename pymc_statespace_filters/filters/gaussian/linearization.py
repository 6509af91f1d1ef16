"""A system taken for linear around the mean of a Gaussian state, as graphs.

What the extended Kalman filter and its smoother share. The state of the filter is one vector: the
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
    """The length of the vector of a filter of n states."""
    return n + n * (n + 1) // 2


def pack(mean: TensorVariable, cov: TensorVariable) -> TensorVariable:
    """A vector and a symmetric matrix as one vector."""
    rows, columns = np.tril_indices(mean.type.shape[0])
    return pt.concatenate([mean, cov[rows, columns]])


def unpack(s: TensorVariable, n: int) -> tuple[TensorVariable, TensorVariable]:
    """The vector (n,) and the matrix (n, n) that `pack` made one of."""
    where = np.zeros((n, n), dtype="int64")
    where[np.tril_indices(n)] = np.arange(n * (n + 1) // 2)
    where = np.maximum(where, where.T)
    return s[:n], s[n:][where]


class LinearizedTransition(NamedTuple):
    """One step from a mean on: x' = mean + A (x - mean before) + B q (Eq. 4.9)."""

    mean: TensorVariable
    state_jac: TensorVariable
    noise_jac: TensorVariable


class Innovation(NamedTuple):
    """One observation: residual = C (x - mean) + e, e ~ N(0, noise_cov), with Kalman's gain.

    Rows of C are zero for what was not seen.
    """

    residual: TensorVariable
    seen: TensorVariable
    seen_jac: TensorVariable
    noise_cov: TensorVariable
    innovation_cov: TensorVariable
    chol: TensorVariable
    gain: TensorVariable
    kept: TensorVariable


def linearize_transition(
    system: StateSpaceModel, values: Symbols, mean: TensorVariable
) -> LinearizedTransition:
    """Eqs. 4.8-4.10, at the mean of the state before the step."""
    q = pt.zeros((system.m,))
    forecast = call(system.equations.transition, system, {**values, "x": mean, "q": q})
    return LinearizedTransition(forecast, jacobian_of(forecast, mean), jacobian_of(forecast, q))


def innovation_moments(
    system: StateSpaceModel, values: Symbols, mean: TensorVariable, cov: TensorVariable
) -> Innovation:
    """Eqs. 4.3-4.7, at the mean of the forecast."""
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
    return Innovation(residual, seen, seen_jac, noise_cov, innovation_cov, chol, gain, kept)
