"""The guide of a particle filter: what the rest of the record says about each step.

Along a reference path E with noise qhat the equations are replaced by linear ones,

    x_{k+1} = E_{k+1} + A_k (x_k - E_k) + B_k (q_k - qhat_k),

and the record from step k on then has the log-density

    log psi_k(x) = c_k + lam_k' delta - 1/2 delta' Lam_k delta,    delta = x - E_k,

which a recursion from the last observation back to step 0 computes. It also gives the noise of step
k given the state and all later observations, q | x ~ N(a - K x, R R'): an affine map of the state,
equal for all particles. Noise is standardised, q ~ N(0, I), so that nothing is divided by its
covariance, which may be singular.

The linear equations are those of least mean square error over the distribution of the state given
the whole record, as that follows from the last guide (posterior linearisation, Garcia-Fernandez,
Svensson and Sarkka 2017): E_{k+1}, A and B are means over 2 n + 1 points. Its mean and covariance
come from following the guide, x_{k+1} = E_{k+1} with the noise a - K E_k, to which the first guide
is a Kalman filter. The guide depends on the record and the parameters, not on particles.

Other sources: backward information filter, Mider, Schauer and van der Meulen (2021); residual
bridges, Whitaker, Golightly, Boys and Sherlock (2017).
"""

import math
from typing import NamedTuple

import numpy as np

from pymc_statespace_filters.compiler.native.entry_point import call_address
from pymc_statespace_filters.compiler.native.jit import copy_into, njit_internal
from pymc_statespace_filters.compiler.numerics.small_cholesky import semidefinite_cholesky
from pymc_statespace_filters.filters.ensemble.information import (
    mean_information,
    new_information,
    newton_update,
    update_work,
)
from pymc_statespace_filters.filters.outcomes import is_missing
from pymc_statespace_filters.filters.system_table import linearized_step

_MOST_ITERATIONS = 6
_SETTLED = 1e-3  # square of the move of the path, over the variance of the state


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
    and the lower triangle of Lam, without the observation itself. ``cov`` (J, n (n + 1) / 2) is the
    covariance around the path there. See `lowering.guidance`.
    """

    path: np.ndarray
    steps: np.ndarray
    gains: np.ndarray
    start: np.ndarray
    psi: np.ndarray
    cov: np.ndarray


class _Points(NamedTuple):
    """Points x +- sqrt(scale) L e_a around a state, with the covariance L L^T.

    ``scale`` is 3, with which means of polynomials of the fifth degree in one state are exact, or
    the number of states, if larger, with which no weight is negative.
    """

    root: np.ndarray
    floor: np.ndarray
    active: np.ndarray
    X: np.ndarray
    results: np.ndarray
    scale: float


@njit_internal
def _points(n, m):
    n_points = 2 * n + 1
    return _Points(
        root=np.empty((n, n)), floor=np.zeros(n), active=np.empty(n, np.bool_),
        X=np.empty((n, n_points)), results=np.empty((n + n * n + n * m, n_points)),
        scale=float(max(3, n)),
    )  # fmt: skip


@njit_internal
def make_guide(system, record):
    """Compute the guide of a record; one that changes nothing if the equations cannot be followed.

    Where they cannot be followed along the iterated path, the first one is taken.
    """
    n, m, J = system.n, system.m, record.steps.size
    T, n_cov = record.steps[-1] if J else np.int64(0), n * (n + 1) // 2
    guide = Guide(
        path=np.zeros((T + 1, n)), steps=np.zeros((T, n + n * n + n * m + m)),
        gains=np.zeros((T, 1 + m + m * n + m * (m + 1) // 2)),
        start=np.zeros(1 + n + n * n + n_cov), psi=np.zeros((J, n + n_cov)),
        cov=np.zeros((J, n_cov)),
    )  # fmt: skip
    points = _points(n, m)
    for most_iterations in (_MOST_ITERATIONS, 0):
        _filter(system, record, guide, points)
        _look_back(system, record, guide)
        for _ in range(most_iterations):
            moved = _follow(system, record, guide, points)
            _look_back(system, record, guide)
            if moved < _SETTLED:
                break
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
def _move_path(system, record, guide, k, cov, points):
    """Linearise step k around the path, with the mean noise of its gains, and move the path."""
    n, m = system.n, system.m
    x, gains, step = guide.path[k], guide.gains[k], guide.steps[k]
    n_means = n + n * n + n * m
    for r in range(m):
        q = gains[1 + r]
        for a in range(n):
            q -= gains[1 + m + r * n + a] * x[a]
        step[n_means + r] = q
    _place(x, cov, points)
    t, noise = record.t0 + k * system.dt, step[n_means:]
    linearized_step(system, k, t, noise.ctypes.data, points.X, points.results.ctypes.data)
    weight = 0.5 / points.scale
    for i in range(n_means):
        total = 0.0
        for point in range(1, 2 * n + 1):
            total += points.results[i, point]
        step[i] = weight * total + (1.0 - n / points.scale) * points.results[i, 0]
    for a in range(n):
        guide.path[k + 1, a] = step[a]


@njit_internal
def _place(x, cov, points):
    """Place the points around x; at x itself if there is no root of the covariance."""
    n, root, X, place = x.size, points.root, points.X, 0
    for a in range(n):
        for b in range(a + 1):
            root[a, b] = root[b, a] = cov[place]
            place += 1
    if not semidefinite_cholesky(root, points.floor, points.active):
        root[:] = 0.0
    reach = math.sqrt(points.scale)
    for a in range(n):
        X[a, 0] = x[a]
        for b in range(n):
            X[a, 1 + b] = x[a] + reach * root[a, b]
            X[a, 1 + n + b] = x[a] - reach * root[a, b]


@njit_internal
def _filter(system, record, guide, points):
    """Take as path the means of a Kalman filter with iterated updates."""
    n = system.n
    mean, root = _initial(system)
    cov, update, here = np.empty(n * (n + 1) // 2), update_work(n), new_information(n)
    guide.gains[:] = 0.0
    copy_into(guide.path[0], mean)
    _cov_of(root, cov)
    k = np.int64(0)
    for j in range(record.steps.size):
        while k < record.steps[j]:
            _move_path(system, record, guide, k, cov, points)
            call_address(system.forecast_cov, (guide.steps[k], cov))
            k += 1
        if not is_missing(record.observed, j):
            newton_update(system, record, j, guide.path[k], cov, update, here)
        copy_into(guide.cov[j], cov)


@njit_internal
def _cov_of(root, cov):
    """Write the lower triangle of L L^T."""
    place = 0
    for a in range(root.shape[0]):
        for b in range(a + 1):
            cov[place] = 0.0
            for c in range(root.shape[0]):
                cov[place] += root[a, c] * root[b, c]
            place += 1


@njit_internal
def _follow(system, record, guide, points):
    """Replace the path by the one along which the guide's mean noise leads; how far it moved."""
    n, T = system.n, guide.steps.shape[0]
    cov, last, moved, j = np.empty(n * (n + 1) // 2), np.empty(n), 0.0, 0
    _guided_start(system, guide, cov)
    for k in range(T + 1):
        if k > 0:
            copy_into(last, guide.path[k])
            _move_path(system, record, guide, np.int64(k - 1), cov, points)
            call_address(system.smoothed_cov, (guide.steps[k-1], guide.gains[k-1, 1:], cov))
        if j < record.steps.size and record.steps[j] == k:
            copy_into(guide.cov[j], cov)
            place = 0
            for a in range(n):
                change = guide.path[k, a] - last[a]
                if k > 0 and cov[place + a] > 0.0:
                    moved = max(moved, change * change / cov[place + a])
                place += a + 1
            j += 1
    return moved


@njit_internal
def _guided_start(system, guide, cov):
    """Begin the path at the mean of the guided start, and write its covariance."""
    n, place = system.n, 1 + system.n + system.n * system.n
    mean, root = _initial(system)
    spread = np.zeros((n, n))
    for a in range(n):
        guide.path[0, a] = mean[a]
        for b in range(n):
            guide.path[0, a] += root[a, b] * guide.start[1 + b]
    for r in range(n):
        for c in range(r, n):
            for a in range(n):
                spread[a, c] += root[a, r] * guide.start[place]
            place += 1
    _cov_of(spread, cov)


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
