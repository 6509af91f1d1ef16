"""The guide of a particle filter: what the rest of the record says about each step.

Along a reference path E with noise qhat, E_{k+1} = g(E_k, qhat_k), the equations are linear in
delta = x - E, and the record from step k on has the log-density

    log psi_k(x) = c_k + lam_k' delta - 1/2 delta' Lam_k delta,

which a recursion from the last observation back to step 0 computes. It also gives the noise of step
k given the state and all later observations, q | x ~ N(a - K x, R R'): an affine map of the state,
equal for all particles. Noise is standardised, q ~ N(0, I), so that nothing is divided by its
covariance, which may be singular.

The reference is the most probable path, by Gauss-Newton iterations from that of an extended Kalman
filter: each follows the noise a - K x and linearises along the new path. It depends on the record
and the parameters, not on particles.

Sources: information filter, Mider, Schauer and van der Meulen (2021), Eqs. 2.9 to 2.14, in discrete
time; residual bridges, Whitaker, Golightly, Boys and Sherlock (2017); Gauss-Newton smoother, Bell
(1994).
"""

import math
from typing import NamedTuple

import numpy as np

from pymc_statespace_filters.compiler.native.jit import copy_into, njit_internal
from pymc_statespace_filters.compiler.numerics.small_cholesky import (
    cholesky,
    solve_lower,
    solve_lower_transposed,
)
from pymc_statespace_filters.filters.ensemble.information import (
    Information,
    UpdateWork,
    information_at,
    new_information,
    newton_update,
    update_work,
)
from pymc_statespace_filters.filters.outcomes import is_missing
from pymc_statespace_filters.filters.system_table import linearized_step

_N_ITERATIONS = 2  # Gauss-Newton iterations; a third changes nothing on the records of the docs


class Record(NamedTuple):
    """Observations (J, p) at steps (J,), and the time of step 0."""

    steps: np.ndarray
    observed: np.ndarray
    t0: float


class Guide(NamedTuple):
    """The guide along a record of T steps and J observations, n states and m noises.

    ``path`` (T + 1, n) and ``noise`` (T, m) are the reference; ``steps`` (T, n + n^2 + n m) its
    linearised steps. ``gains`` (T, ..) shift the noise of a step, see `lowering.guidance`, and
    ``log_dets`` (T,) are log det R. ``start`` (n + n^2) is the mean and the root of the normals at
    step 0, and ``start_log_det`` (1,) its log-determinant. ``psi`` (J, n + n^2) is lam, then Lam,
    of log psi at an observation, without the observation itself.
    """

    path: np.ndarray
    noise: np.ndarray
    steps: np.ndarray
    gains: np.ndarray
    log_dets: np.ndarray
    start: np.ndarray
    start_log_det: np.ndarray
    psi: np.ndarray


class _Work(NamedTuple):
    """Vectors and matrices of one step.

    ``ahead`` is the score and information of later observations, ``here`` that of one. ``shift`` is
    the next state at the old reference and no noise, ``slope`` the score there. Row a of ``gain``
    is column a of K, ``root`` the lower factor of R^-T R^-1, row r of ``spread`` that of R.
    """

    P: np.ndarray
    product: np.ndarray
    shift: np.ndarray
    slope: np.ndarray
    weighted: np.ndarray
    mean: np.ndarray
    root: np.ndarray
    spread: np.ndarray
    gain: np.ndarray
    ahead: Information
    here: Information
    update: UpdateWork


@njit_internal
def _work(n, m):
    size = max(n, m)
    return _Work(
        P=np.empty((n, n)), product=np.empty((n, n)), shift=np.empty(n), slope=np.empty(n),
        weighted=np.empty((size, n)), mean=np.empty(size), root=np.empty((size, size)),
        spread=np.empty((size, size)), gain=np.empty((n, size)), ahead=new_information(n),
        here=new_information(n), update=update_work(n),
    )  # fmt: skip


@njit_internal
def make_guide(system, record):
    """Compute the guide of a record."""
    n, m, J = system.n, system.m, record.steps.size
    T = record.steps[-1] if J else np.int64(0)
    guide = Guide(
        path=np.zeros((T + 1, n)), noise=np.zeros((T, m)), steps=np.zeros((T, n + n * n + n * m)),
        gains=np.zeros((T, m + m * n + m * (m + 1) // 2)), log_dets=np.zeros(T),
        start=np.zeros(n + n * n), start_log_det=np.zeros(1), psi=np.zeros((J, n + n * n)),
    )  # fmt: skip
    work = _work(n, m)
    _filter(system, record, guide, work)
    _look_back(system, record, guide, work)
    for _ in range(_N_ITERATIONS):
        _follow(system, record, guide)
        _look_back(system, record, guide, work)
    return guide


@njit_internal
def _initial(system):
    """Mean (n,) and root (n, n) of the covariance at step 0."""
    n, first = system.n, system.n_theta
    mean = system.c[first : first + n]
    return mean, system.c[first + n : first + n + n * n].reshape(n, n)


@njit_internal
def _linearize(system, record, guide, k):
    """Linearise step k at the path and the noise, and move the path to the next state."""
    x, z, row = guide.path[k], guide.noise[k], guide.steps[k]
    point = x.reshape(x.size, 1)
    linearized_step(system, k, record.t0 + k * system.dt, z.ctypes.data, point, row.ctypes.data)
    copy_into(guide.path[k + 1], row[: x.size])


@njit_internal
def _jacobians(guide, k, n, m):
    row = guide.steps[k]
    return row[n : n + n * n].reshape(n, n), row[n + n * n :].reshape(n, m)


@njit_internal
def _filter(system, record, guide, work):
    """Take as path the means of an extended Kalman filter with iterated updates."""
    mean, root = _initial(system)
    P = work.P
    copy_into(guide.path[0], mean)
    _add_outer(root, P, 0.0)
    k = np.int64(0)
    for j in range(record.steps.size):
        while k < record.steps[j]:
            _linearize(system, record, guide, k)
            A, B = _jacobians(guide, k, system.n, system.m)
            _congruence(A, P, work.product)
            _add_outer(B, P, 1.0)
            k += 1
        if not is_missing(record.observed, j):
            newton_update(system, record, j, guide.path[k], P, work.update, work.here)


@njit_internal
def _add_outer(B, P, keep):
    """Set P to keep P + B B^T."""
    for a in range(B.shape[0]):
        for b in range(a + 1):
            value = keep * P[a, b] if keep else 0.0
            for r in range(B.shape[1]):
                value += B[a, r] * B[b, r]
            P[a, b] = P[b, a] = value


@njit_internal
def _congruence(A, P, product):
    """Set the symmetric P to A P A^T."""
    n = P.shape[0]
    for a in range(n):
        for b in range(n):
            product[a, b] = 0.0
            for c in range(n):
                product[a, b] += A[a, c] * P[c, b]
    for a in range(n):
        for b in range(a + 1):
            value = 0.0
            for c in range(n):
                value += product[a, c] * A[b, c]
            P[a, b] = P[b, a] = value


@njit_internal
def _follow(system, record, guide):
    """Replace the path by the one along which the guide's mean noise leads."""
    n, m = system.n, system.m
    mean, root = _initial(system)
    x = guide.path[0]
    for a in range(n):
        x[a] = mean[a]
        for b in range(n):
            x[a] += root[a, b] * guide.start[b]
    for k in range(guide.noise.shape[0]):
        gains, x = guide.gains[k], guide.path[k]
        for r in range(m):
            q = gains[r]
            for a in range(n):
                q -= gains[m + r * n + a] * x[a]
            guide.noise[k, r] = q
        _linearize(system, record, guide, np.int64(k))


@njit_internal
def _look_back(system, record, guide, work):
    """Compute psi, the gains and the start from the end of the record back to step 0."""
    n, ahead = system.n, work.ahead
    ahead.score[:] = 0.0
    ahead.matrix[:] = 0.0
    j = record.steps.size - 1
    for k in range(guide.noise.shape[0], -1, -1):
        if k < guide.noise.shape[0]:
            _step_back(system, guide, k, work)
        if j >= 0 and record.steps[j] == k:
            copy_into(guide.psi[j, :n], ahead.score)
            copy_into(guide.psi[j, n:], ahead.matrix.reshape(n * n))
            _observe(system, record, j, guide.path[k], work)
            j -= 1
    _guide_start(system, guide, work)


@njit_internal
def _observe(system, record, j, x, work):
    """Add the information of an observation."""
    ahead, here = work.ahead, work.here
    if is_missing(record.observed, j) or not information_at(system, record, j, x, here):
        return
    for a in range(x.size):
        ahead.score[a] += here.score[a]
        for b in range(x.size):
            ahead.matrix[a, b] += here.matrix[a, b]


@njit_internal
def _step_back(system, guide, k, work):
    """Condition the noise of step k on what is ahead, and move psi from step k + 1 to k."""
    n, m = system.n, system.m
    A, B = _jacobians(guide, k, n, m)
    for a in range(n):
        work.shift[a] = guide.steps[k, a] - guide.path[k + 1, a]
        for r in range(m):
            work.shift[a] -= B[a, r] * guide.noise[k, r]
    guide.log_dets[k] = _condition(B, work)
    for a in range(n):
        column = work.gain[a, :m]
        for r in range(m):
            column[r] = 0.0
            for b in range(n):
                column[r] += work.weighted[r, b] * A[b, a]
        solve_lower(work.root[:m, :m], column)
        solve_lower_transposed(work.root[:m, :m], column)
    _store_gains(guide.gains[k], guide.path[k], m, work)
    _pull_back(A, B, work)


@njit_internal
def _condition(B, work):
    """Mean and root of noise that moves the next state by B; return log det R.

    Its precision is I + B^T Lam B, so the factorisation cannot fail unless psi is not finite; what
    is ahead is then forgotten.
    """
    n, m = B.shape
    ahead, H = work.ahead, work.root[:m, :m]
    for a in range(n):
        work.slope[a] = ahead.score[a]
        for b in range(n):
            work.slope[a] -= ahead.matrix[a, b] * work.shift[b]
    for r in range(m):
        work.mean[r] = 0.0
        for a in range(n):
            work.mean[r] += B[a, r] * work.slope[a]
            work.weighted[r, a] = 0.0
            for b in range(n):
                work.weighted[r, a] += B[b, r] * ahead.matrix[b, a]
    for r in range(m):
        for c in range(m):
            H[r, c] = 1.0 if r == c else 0.0
            for a in range(n):
                H[r, c] += work.weighted[r, a] * B[a, c]
    if not (np.isfinite(work.mean[:m]).all() and cholesky(H)):
        ahead.score[:] = 0.0
        ahead.matrix[:] = 0.0
        work.slope[:] = 0.0
        work.weighted[:] = 0.0
        work.mean[:] = 0.0
        for r in range(m):
            for c in range(m):
                H[r, c] = 1.0 if r == c else 0.0
    solve_lower(H, work.mean[:m])
    solve_lower_transposed(H, work.mean[:m])
    log_det = 0.0
    for r in range(m):
        for c in range(m):
            work.spread[r, c] = 1.0 if r == c else 0.0
        solve_lower(H, work.spread[r, :m])
        log_det -= math.log(H[r, r])
    return log_det


@njit_internal
def _store_gains(gains, x, m, work):
    """Write a, K and the upper triangle of R."""
    n = x.size
    place = m + m * n
    for r in range(m):
        gains[r] = work.mean[r]
        for a in range(n):
            gains[r] += work.gain[a, r] * x[a]
            gains[m + r * n + a] = work.gain[a, r]
        for c in range(r, m):
            gains[place] = work.spread[r, c]
            place += 1


@njit_internal
def _pull_back(A, B, work):
    """Move psi over a step, in a form whose information cannot become negative.

    With the closed loop F = A - B K: lam = F^T l and Lam = F^T Lam' F + K^T K.
    """
    n, m = B.shape
    ahead, F, product = work.ahead, work.P, work.product
    for a in range(n):
        for b in range(n):
            F[a, b] = A[a, b]
            for r in range(m):
                F[a, b] -= B[a, r] * work.gain[b, r]
    for a in range(n):
        ahead.score[a] = 0.0
        for b in range(n):
            ahead.score[a] += F[b, a] * work.slope[b]
            product[a, b] = 0.0
            for c in range(n):
                product[a, b] += ahead.matrix[a, c] * F[c, b]
    for a in range(n):
        for b in range(a + 1):
            value = 0.0
            for c in range(n):
                value += F[c, a] * product[c, b]
            for r in range(m):
                value += work.gain[a, r] * work.gain[b, r]
            ahead.matrix[a, b] = ahead.matrix[b, a] = value


@njit_internal
def _guide_start(system, guide, work):
    """Condition the normals of the state at step 0."""
    n = system.n
    mean, root = _initial(system)
    for a in range(n):
        work.shift[a] = mean[a] - guide.path[0, a]
    guide.start_log_det[0] = _condition(root, work)
    for r in range(n):
        guide.start[r] = work.mean[r]
        for c in range(n):
            guide.start[n + r * n + c] = work.spread[r, c] if c >= r else 0.0
