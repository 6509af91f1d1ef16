"""What one observation says about the state: a quadratic form of its log-density at a point."""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import copy_into, njit_internal
from ...compiler.numerics.small_cholesky import semidefinite_cholesky
from ..plan import observation_information

_N_NEWTON, _N_HALVINGS = 12, 12
_CONVERGED = 1e-4  # nats
_N_SWEEPS = 30  # of Jacobi rotations; a few suffice


class Information(NamedTuple):
    """``row`` (1 + n + n^2) holds log p(d | x), its score and its information matrix.

    The others are scratch: sums over points, a point, and the root of a covariance.
    """

    row: np.ndarray
    score: np.ndarray
    matrix: np.ndarray
    total: np.ndarray
    point: np.ndarray
    root: np.ndarray
    floor: np.ndarray
    active: np.ndarray


@njit_internal
def new_information(n):
    """Room for the information of one observation."""
    row = np.zeros(1 + n + n * n)
    return Information(
        row=row, score=row[1 : 1 + n], matrix=row[1 + n :].reshape(n, n), total=np.empty(row.size),
        point=np.empty(n), root=np.empty((n, n)), floor=np.zeros(n), active=np.empty(n, np.bool_),
    )  # fmt: skip


@njit_internal
def information_at(system, record, j, x, out):
    """Write the information of observation j at the state x; False if it is not finite.

    Directions in which the log-density is convex, such as those of an outlier under heavy tails,
    get no information.
    """
    k, d = record.steps[j], record.observed[j]
    t = record.t0 + k * system.dt
    observation_information(system, k, t, d.ctypes.data, x.reshape(x.size, 1), out.row.ctypes.data)
    for i in range(out.row.size):
        if not np.isfinite(out.row[i]):
            return False
    if not system.has_gaussian_observation:
        _drop_negative(out.matrix)
    return True


@njit_internal
def mean_information(system, record, j, x, cov, out):
    """As `information_at`, in the mean over a normal distribution around x.

    The mean over 2 n + 1 points is a better quadratic form than that at x where the log-density is
    skewed. That of Gaussian noise is taken at x. The log-density is the quadratic form's at x.
    """
    if system.has_gaussian_observation or not _take_root(cov, out):
        return information_at(system, record, j, x, out)
    n, scale = x.size, max(3.0, float(x.size))
    if not information_at(system, record, j, x, out):
        return False
    for i in range(out.total.size):
        out.total[i] = (1.0 - n / scale) * out.row[i]
    for a in range(n):
        for sign in (-1.0, 1.0):
            for b in range(n):
                out.point[b] = x[b] + sign * math.sqrt(scale) * out.root[b, a]
            if not information_at(system, record, j, out.point, out):
                return information_at(system, record, j, x, out)
            for i in range(out.total.size):
                out.total[i] += 0.5 / scale * out.row[i]
    copy_into(out.row, out.total)
    for a in range(n):
        for b in range(n):
            for c in range(n):
                out.row[0] += 0.5 * out.matrix[a, b] * out.root[a, c] * out.root[b, c]
    return True


@njit_internal
def _take_root(cov, out):
    """Write the root of a covariance, given by its lower triangle."""
    place = 0
    for a in range(out.root.shape[0]):
        for b in range(a + 1):
            out.root[a, b] = out.root[b, a] = cov[place]
            place += 1
    return semidefinite_cholesky(out.root, out.floor, out.active)


@njit_internal
def _drop_negative(A):
    """Replace the negative eigenvalues of a symmetric matrix by zero, by Jacobi rotations."""
    n = A.shape[0]
    if n == 1:
        A[0, 0] = max(A[0, 0], 0.0)
        return
    V = np.eye(n)
    for _ in range(_N_SWEEPS):
        rest, scale = 0.0, 0.0
        for a in range(n):
            scale += A[a, a] * A[a, a]
            for b in range(a):
                rest += A[a, b] * A[a, b]
        if rest <= 1e-30 * scale:
            break
        for a in range(n):
            for b in range(a):
                _rotate(A, V, b, a)
    values = np.empty(n)
    for a in range(n):
        values[a] = max(A[a, a], 0.0)
    for a in range(n):
        for b in range(n):
            A[a, b] = 0.0
            for c in range(n):
                A[a, b] += V[a, c] * values[c] * V[b, c]


@njit_internal
def _rotate(A, V, a, b):
    """Rotate away the element (a, b) of A, and V with it."""
    if A[a, b] == 0.0:
        return
    ratio = (A[b, b] - A[a, a]) / (2.0 * A[a, b])
    tangent = 1.0 / (abs(ratio) + np.sqrt(ratio * ratio + 1.0))
    if ratio < 0.0:
        tangent = -tangent
    cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
    sine = tangent * cosine
    for c in range(A.shape[0]):
        A[c, a], A[c, b] = cosine * A[c, a] - sine * A[c, b], sine * A[c, a] + cosine * A[c, b]
    for c in range(A.shape[0]):
        A[a, c], A[b, c] = cosine * A[a, c] - sine * A[b, c], sine * A[a, c] + cosine * A[b, c]
        V[c, a], V[c, b] = cosine * V[c, a] - sine * V[c, b], sine * V[c, a] + cosine * V[c, b]


class UpdateWork(NamedTuple):
    """Vectors and matrices of an update."""

    mean: np.ndarray
    coordinates: np.ndarray
    target: np.ndarray
    trial: np.ndarray
    matrix: np.ndarray
    cov: np.ndarray
    new_cov: np.ndarray


@njit_internal
def update_work(n):
    """Room for updates of n states."""
    return UpdateWork(
        mean=np.empty(n), coordinates=np.empty(n), target=np.empty((1, n)), trial=np.empty(n),
        matrix=np.empty((n, n)), cov=np.empty((n, n)), new_cov=np.empty((n, n)),
    )  # fmt: skip


@njit_internal
def newton_update(system, record, j, x, cov, work, here):
    """Move the mean x to the mode given observation j, by Newton's method, and update ``cov``.

    The iteration is in s with x = mean + P s, so that P may be singular. A step that does not
    raise the density is halved. If the observation has no finite density at the mean, nothing is
    updated. Returns the log of the observation's evidence by Laplace's approximation.
    """
    n, s, target, P = x.size, work.coordinates, work.target, work.cov
    place = 0
    for a in range(n):
        for b in range(a + 1):
            P[a, b] = P[b, a] = cov[place]
            place += 1
    copy_into(work.mean, x)
    s[:] = 0.0
    if not information_at(system, record, j, x, here):
        return -np.inf
    cost = -here.row[0]
    for _ in range(_N_NEWTON):
        _fill_target(x, P, work, here)
        step, last = 1.0, cost
        for _ in range(_N_HALVINGS):
            for a in range(n):
                work.trial[a] = s[a] + step * (target[0, a] - s[a])
            cost = _cost_at(system, record, j, x, P, work, here)
            if cost <= last + 1e-10 * abs(last):
                break
            step *= 0.5
        if not cost <= last + 1e-10 * abs(last):
            copy_into(work.trial, s)
            cost = _cost_at(system, record, j, x, P, work, here)
            break
        copy_into(s, work.trial)
        if last - cost < _CONVERGED:
            break
    return -cost - 0.5 * _update_cov(cov, work, here)


@njit_internal
def _fill_target(x, P, work, here):
    """Solve (I + Lam P) s = score + Lam (x - mean): Newton's next s."""
    n = x.size
    for a in range(n):
        work.target[0, a] = here.score[a]
        for b in range(n):
            work.target[0, a] += here.matrix[a, b] * (x[b] - work.mean[b])
            work.matrix[a, b] = 1.0 if a == b else 0.0
            for c in range(n):
                work.matrix[a, b] += here.matrix[a, c] * P[c, b]
    _solve(work.matrix, work.target)


@njit_internal
def _cost_at(system, record, j, x, P, work, here):
    """Set x to mean + P s for the trial s; return s^T P s / 2 - log p(d | x), inf if not finite."""
    cost = 0.0
    for a in range(x.size):
        move = 0.0
        for b in range(x.size):
            move += P[a, b] * work.trial[b]
        x[a] = work.mean[a] + move
        cost += 0.5 * work.trial[a] * move
    return cost - here.row[0] if information_at(system, record, j, x, here) else np.inf


@njit_internal
def _update_cov(cov, work, here):
    """Set the lower triangle ``cov`` to that of (I + P Lam)^-1 P; log det (I + P Lam)."""
    P, new = work.cov, work.new_cov
    n, place = P.shape[0], 0
    for a in range(n):
        for b in range(n):
            new[a, b] = P[a, b]
            work.matrix[a, b] = 1.0 if a == b else 0.0
            for c in range(n):
                work.matrix[a, b] += P[a, c] * here.matrix[c, b]
    _solve(work.matrix, new)
    log_det = 0.0
    for a in range(n):
        log_det += math.log(abs(work.matrix[a, a]))
        for b in range(a + 1):
            cov[place] = 0.5 * (new[a, b] + new[b, a])
            place += 1
    return log_det


@njit_internal
def _solve(A, rows):
    """Replace every row b by the solution of A x = b, by elimination; A is overwritten."""
    n = A.shape[0]
    for j in range(n):
        best = j
        for i in range(j + 1, n):
            if abs(A[i, j]) > abs(A[best, j]):
                best = i
        if best != j:
            for c in range(n):
                A[j, c], A[best, c] = A[best, c], A[j, c]
            for row in range(rows.shape[0]):
                rows[row, j], rows[row, best] = rows[row, best], rows[row, j]
        for i in range(j + 1, n):
            factor = A[i, j] / A[j, j]
            for c in range(j + 1, n):
                A[i, c] -= factor * A[j, c]
            for row in range(rows.shape[0]):
                rows[row, i] -= factor * rows[row, j]
    for row in range(rows.shape[0]):
        for i in range(n - 1, -1, -1):
            for c in range(i + 1, n):
                rows[row, i] -= A[i, c] * rows[row, c]
            rows[row, i] /= A[i, i]
