"""Graphs of a guided particle filter: steps linearised at a point, and noise shifted by a guide."""

from collections.abc import Mapping

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.tensor.linalg import cholesky, solve_triangular
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.lowering.gaussian import (
    log_normal,
    observation_log_density,
    without_missing,
)
from pymc_statespace_filters.compiler.lowering.symbols import jacobian_of, observation_moments
from pymc_statespace_filters.system.model import StateSpaceModel


def n_gains(n: int, m: int) -> int:
    """How many numbers guide the m normals of a step from n states."""
    return m + m * n + m * (m + 1) // 2


def guided_noise(
    gains: TensorVariable, x: TensorVariable, z: TensorVariable
) -> tuple[TensorVariable, TensorVariable]:
    """Noise q = a - K x + R z, and log N(q; 0, I) - log N(z; 0, I).

    ``gains`` are the vector a, the rows of K, and the rows of the upper triangle of R. The ratio
    lacks log det R, which all members share.
    """
    n, m = x.type.shape[0], z.type.shape[0]
    K = gains[m : m + m * n].reshape((m, n))
    position = np.full((m, m), m + m * n)
    upper = np.triu_indices(m)
    position[upper] += np.arange(m * (m + 1) // 2)
    R = gains[position] * np.triu(np.ones((m, m)))
    q = gains[:m] - K @ x + R @ z
    return q, 0.5 * (pt.sum(z**2) - pt.sum(q**2))


def linearize_step(
    step: TensorVariable, x: TensorVariable, z: TensorVariable, free: np.ndarray
) -> TensorVariable:
    """The next state, then the rows of its Jacobians A with respect to x and B to z.

    States that are not free are taken as known: their rows and columns are zero.
    """
    is_free = np.zeros(x.type.shape[0])
    is_free[free] = 1.0
    A = jacobian_of(step, x) * np.outer(is_free, is_free)
    B = jacobian_of(step, z) * is_free[:, None]
    return pt.concatenate([step, A.ravel(), B.ravel()])


def observation_information(
    system: StateSpaceModel, symbols: Mapping[str, TensorVariable], free: np.ndarray
) -> TensorVariable:
    """log p(d | x), its gradient in x, and the rows of its information matrix.

    Of Gaussian noise the matrix is the expected information C^T Gamma^-1 C, else the negative
    Hessian, which need not be positive.
    """
    is_free = np.zeros(system.n)
    is_free[free] = 1.0
    x = symbols["x"]
    if not system.gaussian_observation:
        log_density = observation_log_density(system, symbols)
        score = pytensor.grad(log_density, x, disconnected_inputs="ignore") * is_free
        information = -jacobian_of(pt.specify_shape(score, (system.n,)), x) * is_free
        return pt.concatenate([[log_density], score, information.ravel()])
    mean, cov = observation_moments(system, symbols)
    residual, cov, seen = without_missing(symbols["d"], mean, cov)
    jac = jacobian_of(mean, x) * seen[:, None] * is_free
    root = cholesky(cov, lower=True)
    whitened_jac = solve_triangular(root, jac, lower=True, b_ndim=2)
    whitened = solve_triangular(root, residual, lower=True, b_ndim=1)
    log_density = log_normal(residual, cov, seen)
    information = whitened_jac.T @ whitened_jac
    return pt.concatenate([[log_density], whitened_jac.T @ whitened, information.ravel()])
