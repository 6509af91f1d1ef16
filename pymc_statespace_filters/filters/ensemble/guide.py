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

from typing import NamedTuple

import numpy as np

from pymc_statespace_filters.compiler.native.entry_point import call_address
from pymc_statespace_filters.compiler.native.jit import copy_into, njit_internal
from pymc_statespace_filters.filters.ensemble.information import (
    mean_information,
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

    ``path`` (T + 1, n) is the reference, ``steps`` (T, ..) its linearised steps. A row of ``gains``
    (T, ..) is log det R of a step and what shifts its noise, ``start`` the same for the normals at
    step 0, of which there are n. ``psi`` (J, n + n (n + 1) / 2) is log psi at an observation, lam
    and the lower triangle of Lam, without the observation itself. See `lowering.guidance`.
    """

    path: np.ndarray
    steps: np.ndarray
    gains: np.ndarray
    start: np.ndarray
    psi: np.ndarray
    cov: np.ndarray


@njit_internal
def make_guide(system, record):
    """Compute the guide of a record; one that changes nothing if the equations cannot be followed.

    Where they cannot be followed along the iterated path, the first one is taken.
    """
    n, m, J = system.n, system.m, record.steps.size
    T, n_psi = record.steps[-1] if J else np.int64(0), n + n * (n + 1) // 2
    guide = Guide(
        path=np.zeros((T + 1, n)), steps=np.zeros((T, n + n * n + n * m + m)),
        gains=np.zeros((T, 1 + m + m * n + m * (m + 1) // 2)),
        start=np.zeros(1 + n + n * n + n * (n + 1) // 2), psi=np.zeros((J, n_psi)),
        cov=np.zeros((J, n_psi - n)),
    )  # fmt: skip
    for n_iterations in (_N_ITERATIONS, 0):
        _filter(system, record, guide)
        _look_back(system, record, guide)
        for _ in range(n_iterations):
            _follow(system, record, guide)
            _look_back(system, record, guide)
        if np.isfinite(guide.path).all():
            return guide
    guide.path[:] = 0.0
    guide.psi[:] = 0.0
    for k in range(T):
        _leave_unguided(guide.gains[k], n, m)
    _leave_unguided(guide.start, n, n)
    return guide


@njit_internal
def _initial(system):
    """Mean (n,) and root (n, n) of the covariance at step 0."""
    n, first = system.n, system.n_theta
    mean = system.c[first : first + n]
    return mean, system.c[first + n : first + n + n * n].reshape(n, n)


@njit_internal
def _move_path(system, record, guide, k):
    """Linearise step k at the path, with the mean noise of its gains, and move the path there."""
    x, gains, step = guide.path[k], guide.gains[k, 1:], guide.steps[k]
    point, t = x.reshape(x.size, 1), record.t0 + k * system.dt
    linearized_step(system, k, t, gains.ctypes.data, point, step.ctypes.data)
    copy_into(guide.path[k + 1], step[: x.size])


@njit_internal
def _filter(system, record, guide):
    """Take as path the means of an extended Kalman filter with iterated updates."""
    n = system.n
    mean, root = _initial(system)
    cov, update, here = np.empty(n * (n + 1) // 2), update_work(n), new_information(n)
    guide.gains[:] = 0.0
    copy_into(guide.path[0], mean)
    place = 0
    for a in range(n):
        for b in range(a + 1):
            cov[place] = 0.0
            for c in range(n):
                cov[place] += root[a, c] * root[b, c]
            place += 1
    k = np.int64(0)
    for j in range(record.steps.size):
        while k < record.steps[j]:
            _move_path(system, record, guide, k)
            call_address(system.forecast_cov, (guide.steps[k], cov))
            k += 1
        if not is_missing(record.observed, j):
            newton_update(system, record, j, guide.path[k], cov, update, here)


@njit_internal
def _follow(system, record, guide):
    """Replace the path by the one along which the guide's mean noise leads."""
    n = system.n
    mean, root = _initial(system)
    x = guide.path[0]
    for a in range(n):
        x[a] = mean[a]
        for b in range(n):
            x[a] += root[a, b] * guide.start[1 + b]
    cov, j, T = np.zeros(n * (n + 1) // 2), 0, guide.steps.shape[0]
    _start_cov(root, guide.start[1 + n + n * n :], cov)
    for k in range(T + 1):
        if j < record.steps.size and record.steps[j] == k:
            copy_into(guide.cov[j], cov)
            j += 1
        if k < T:
            _move_path(system, record, guide, np.int64(k))
            call_address(system.smoothed_cov, (guide.steps[k], guide.gains[k, 1:], cov))


@njit_internal
def _start_cov(root, spread, cov):
    """Lower triangle of L R R^T L^T, R upper triangular."""
    n = root.shape[0]
    LR = np.zeros((n, n))
    place = 0
    for r in range(n):
        for c in range(r, n):
            for a in range(n):
                LR[a, c] += root[a, r] * spread[place]
            place += 1
    place = 0
    for a in range(n):
        for b in range(a + 1):
            cov[place] = 0.0
            for c in range(n):
                cov[place] += LR[a, c] * LR[b, c]
            place += 1


@njit_internal
def _look_back(system, record, guide):
    """Compute psi, the gains and the start from the end of the record back to step 0."""
    n, m, T = system.n, system.m, guide.steps.shape[0]
    psi, here = np.zeros(n + n * (n + 1) // 2), new_information(n)
    j = record.steps.size - 1
    for k in range(T, -1, -1):
        if k < T:
            call_address(
                system.step_back, (guide.steps[k], guide.path[k], psi, guide.gains[k])
            )
            if not np.isfinite(guide.gains[k, 0]):
                psi[:] = 0.0
                _leave_unguided(guide.gains[k], n, m)
        if j >= 0 and record.steps[j] == k:
            copy_into(guide.psi[j], psi)
            if not is_missing(record.observed, j):
                _add_observation(system, record, j, guide.path[k], guide.cov[j], here, psi)
            j -= 1
    mean, root = _initial(system)
    first, path = np.zeros(n + 2 * n * n + n), np.zeros(2 * n)
    copy_into(first[:n], mean)
    copy_into(first[n + n * n : n + 2 * n * n], root.reshape(n * n))
    copy_into(path[n:], guide.path[0])
    call_address(system.start_back, (first, path, psi, guide.start))
    if not np.isfinite(guide.start[0]):
        _leave_unguided(guide.start, n, n)


@njit_internal
def _add_observation(system, record, j, x, cov, here, psi):
    """Add the information of an observation to psi."""
    if mean_information(system, record, j, x, cov, here):
        place = n = x.size
        for a in range(n):
            psi[a] += here.score[a]
            for b in range(a + 1):
                psi[place] += here.matrix[a, b]
                place += 1


@njit_internal
def _leave_unguided(gains, n, m):
    """Gains of noise that is not shifted."""
    gains[:] = 0.0
    place = 1 + m + m * n
    for r in range(m):
        gains[place] = 1.0
        place += m - r
