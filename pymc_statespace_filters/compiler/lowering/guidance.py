"""Graphs of a guided particle filter: steps linearised at a point, and noise shifted by a guide."""

from collections.abc import Mapping

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.tensor.linalg import cholesky, solve_triangular
from pytensor.tensor.variable import TensorVariable

from ...system.model import StateSpaceModel
from ..codegen.function_types import Graph
from .observation import log_normal, observation_log_density, without_missing
from .symbols import jacobian_of, observation_moments


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
    a, K, R = _gain_parts(gains, n, m)
    q = a - K @ x + R @ z
    return q, 0.5 * (pt.sum(z**2) - pt.sum(q**2))


def linearize_step(
    step: TensorVariable, x: TensorVariable, q: TensorVariable, free: np.ndarray
) -> TensorVariable:
    """The next state and the rows of its Jacobians A with respect to x and B to q.

    States that are not free are taken as known: their rows and columns are zero.
    """
    is_free = np.zeros(x.type.shape[0])
    is_free[free] = 1.0
    A = jacobian_of(step, x) * np.outer(is_free, is_free)
    B = jacobian_of(step, q) * is_free[:, None]
    return pt.concatenate([step, A.ravel(), B.ravel()])


def step_size(n: int, m: int) -> int:
    """Length of a linearised step: the next state, A, B, the noise q there, and a covariance.

    It is that of what the linear equations leave out, a lower triangle.
    """
    return n + n * n + n * m + m + n * (n + 1) // 2


def smoothed_cov(n: int, m: int) -> Graph:
    """Covariance of the next state given the record, from that of the state and its gains."""
    step, gains = _vector("step", step_size(n, m)), _vector("gains", n_gains(n, m))
    cov = _vector("cov", n * (n + 1) // 2)
    _, A, B, _ = _parts(step, n, m)
    _, K, R = _gain_parts(gains, n, m)
    F, spread = A - B @ K, B @ R
    forecast = F @ _symmetric(cov, n) @ F.T + spread @ spread.T
    return Graph({"step": step, "gains": gains, "cov": cov}, [forecast[np.tril_indices(n)]])


def _gain_parts(gains: TensorVariable, n: int, m: int) -> tuple[TensorVariable, ...]:
    """The vector a and the matrices K and R."""
    position = np.full((m, m), m + m * n)
    upper = np.triu_indices(m)
    position[upper] += np.arange(m * (m + 1) // 2)
    R = gains[position] * np.triu(np.ones((m, m)))
    return gains[:m], gains[m : m + m * n].reshape((m, n)), R


def step_back(n: int, m: int) -> Graph:
    """Condition the noise of a step on what is ahead, and move psi back over the step.

    Inputs are a linearised step, the reference ``path`` (2 n) before and after it, and ``psi``:
    score, then the lower triangle of the information, at the reference after it. The output is
    psi before the step, then log det R, then the gains of `guided_noise`.

    With the closed loop F = A - B K the information is F^T Lam F + K^T K, which rounding cannot
    make negative.
    """
    step, path = _vector("step", step_size(n, m)), _vector("path", 2 * n)
    psi = _vector("psi", n + n * (n + 1) // 2)
    after, A, B, q = _parts(step, n, m)
    score, Lam = psi[:n], _symmetric(psi[n:], n)
    slope = score - Lam @ (after - path[n:] - B @ q)
    weighted = B.T @ Lam
    root = cholesky(pt.eye(m) + weighted @ B, lower=True)
    R = solve_triangular(root.T, np.eye(m), lower=False, b_ndim=2)
    K = R @ (R.T @ (weighted @ A))
    mean = R @ (R.T @ (B.T @ slope))
    F = A - B @ K
    information = F.T @ Lam @ F + K.T @ K
    before = [F.T @ slope, information[np.tril_indices(n)]]
    log_det = -pt.sum(pt.log(pt.diagonal(root)))
    gains = [mean + K @ path[:n], K.ravel(), R[np.triu_indices(m)]]
    return Graph(
        {"step": step, "path": path, "psi": psi}, [pt.concatenate([*before, [log_det], *gains])]
    )


def _vector(name: str, size: int) -> TensorVariable:
    return pt.tensor(name, shape=(size,), dtype="float64")


def _parts(step: TensorVariable, n: int, m: int) -> tuple[TensorVariable, ...]:
    """The next state, A, B and q of a linearised step."""
    first, last = n + n * n, n + n * n + n * m
    A, B = step[n:first].reshape((n, n)), step[first:last].reshape((n, m))
    return step[:n], A, B, step[last : last + m]


def _symmetric(triangle: TensorVariable, n: int) -> TensorVariable:
    position = np.zeros((n, n), dtype="int64")
    position[np.tril_indices(n)] = np.arange(n * (n + 1) // 2)
    return triangle[np.maximum(position, position.T)]


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
