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
the whole record (posterior linearisation, Garcia-Fernandez, Svensson and Sarkka 2017): E_{k+1}, A
and B are means over 2 n + 1 points of that distribution. Its means and covariances are found by
iteration. Those of a Kalman filter give the first guide; each guide gives the next ones, by moving
along with the noise a - K E_k. The guide depends on the record and the parameters, not on
particles.

Other sources: backward information filter, Mider, Schauer and van der Meulen (2021); residual
bridges, Whitaker, Golightly, Boys and Sherlock (2017).
"""

from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import copy_into, njit_internal
from ...compiler.numerics.small_cholesky import semidefinite_cholesky
from ..outcomes import is_missing
from ..plan import follow, look_back
from .information import mean_information, new_information, newton_update, update_work
from .reductions import weighted_cov, weighted_mean

_MOST_ITERATIONS = 8
_SETTLED = 0.01  # square of the move of the path, over the variance of the state
_FALLEN = 1.0  # nats of evidence, below the best iteration


class Beginning(NamedTuple):
    """Where the guide begins: the step, the mean (n,) of the state, and a root of its covariance.

    Those at step 0, or of particles that go on.
    """

    step: np.int64
    mean: np.ndarray
    root: np.ndarray


class Guide(NamedTuple):
    """The guide along a record of T steps and J observations, n states and m noises.

    ``path`` (T + 1, n) is the reference, ``steps`` (T, ..) its linearised steps. A row of ``gains``
    (T, ..) is log det R of a step and what shifts its noise, ``start`` the same for the normals at
    the beginning, of which there are n; rows before the beginning are not used. ``psi`` (J + 1,
    n + n (n + 1) / 2) is log psi at the beginning and behind each observation, without the
    observation itself: lam and the lower triangle of Lam. ``cov`` (J, n (n + 1) / 2) is the
    covariance around the path there. See `lowering.guidance`. A row of ``sums`` (J, 2) is of the
    interval that ends at an observation, or at the first one after it that is not missing. The
    first says by how much the linear equations may be wrong there: the mean of delta' Lam delta / 2
    over their residuals, in nats. The second is the log of the factor of the evidence: the weight
    of a particle that moves along the path. ``origin`` (n,) are the normals of the path's start.
    """

    path: np.ndarray
    origin: np.ndarray
    steps: np.ndarray
    gains: np.ndarray
    start: np.ndarray
    psi: np.ndarray
    cov: np.ndarray
    sums: np.ndarray


@njit_internal
def initial_law(system):
    """The law of the state at step 0."""
    n, first = system.n, system.n_theta
    mean, root = np.empty(n), np.empty((n, n))
    copy_into(mean, system.c[first : first + n])
    copy_into(root.reshape(n * n), system.c[first + n : first + n + n * n])
    return Beginning(np.int64(0), mean, root)


@njit_internal
def law_of_particles(system, k, w, X, local):
    """The moments of weighted particles at step k; carried states are taken as known there."""
    n = system.n
    mean, cov, root = np.empty(n), np.empty((n, n)), np.zeros((n, n))
    weighted_mean(w, X, 1.0, local, mean)
    weighted_cov(w, X, mean, X, mean, 1.0, local, cov)
    for a in system.free:
        for b in system.free:
            root[a, b] = cov[a, b]
    semidefinite_cholesky(root, np.zeros(n), np.empty(n, np.bool_))
    return Beginning(k, mean, root)


@njit_internal
def make_guide(system, record, beginning):
    """Compute the guide of a record; one that changes nothing if the equations cannot be followed.

    An iteration that diverges goes back to the guide of most evidence.
    """
    n, m, J = system.n, system.m, record.steps.size
    T, n_cov = record.steps[-1] if J else np.int64(0), n * (n + 1) // 2
    guide = Guide(
        path=np.empty((T + 1, n)), origin=np.zeros(n),
        steps=np.empty((T, n + n * n + n * m + m + n_cov)),
        gains=np.empty((T, 1 + m + m * n + m * (m + 1) // 2)),
        start=np.zeros(1 + n + n * n + n_cov), psi=np.zeros((J + 1, n + n_cov)),
        cov=np.zeros((J, n_cov)), sums=np.zeros((J, 2)),
    )  # fmt: skip
    done, best = _iterate(system, record, beginning, guide, _MOST_ITERATIONS)
    if 0 <= best < done:
        _iterate(system, record, beginning, guide, best)
    if best >= 0:
        return guide
    guide.path[beginning.step :] = 0.0
    guide.sums[:] = 0.0
    guide.psi[:] = 0.0
    for k in range(beginning.step, T):
        leave_unguided(guide.gains[k], n, m)
    leave_unguided(guide.start, n, n)
    return guide


@njit_internal
def _iterate(system, record, beginning, guide, most):
    """Iterate a guide; how often, and the iteration to go back to, -1 if no guide is finite.

    It stays where it is if it has settled, or has lost little of the evidence. The path of the
    first guide jumps at observations: its evidence is the filter's, and no interval has a factor.
    """
    guide.origin[:] = 0.0
    evidence = largest = _filter(system, record, beginning, guide)
    _look_back(system, record, beginning, guide)
    best = np.int64(-1 if _evidence(record, beginning, guide) == -np.inf else 0)
    guide.sums[:, 1] = -np.inf
    for done in range(1, most + 1):
        moved = _follow(system, record, beginning, guide)
        _look_back(system, record, beginning, guide)
        evidence = _evidence(record, beginning, guide)
        if evidence > largest:
            largest, best = evidence, np.int64(done)
        if moved < _SETTLED and evidence > -np.inf:
            return np.int64(done), np.int64(done)
    return np.int64(most), np.int64(most) if evidence > largest - _FALLEN else best


@njit_internal
def _evidence(record, beginning, guide):
    """Log-likelihood of the linear system, -inf if it is not finite."""
    if not np.isfinite(guide.path[beginning.step :]).all():
        return -np.inf
    total, begins = 0.0, True
    for j in range(record.steps.size):
        if begins:
            total += guide.sums[j, 1]
        begins = not is_missing(record.observed, j)
    return total if np.isfinite(total) else -np.inf


@njit_internal
def _filter(system, record, beginning, guide):
    """Take as path the means of a Kalman filter with iterated updates; its evidence."""
    n, evidence, first = system.n, 0.0, beginning.step
    cov, update, here = np.empty(n * (n + 1) // 2), update_work(n), new_information(n)
    for k in range(first, guide.gains.shape[0]):
        leave_unguided(guide.gains[k], n, system.m)
    copy_into(guide.path[first], beginning.mean)
    _cov_of(beginning.root, cov)
    for j in range(record.steps.size):
        last = record.steps[j]
        follow(system, first, last, record.t0, guide.path, guide.gains, guide.steps, cov)
        if not is_missing(record.observed, j):
            evidence += newton_update(system, record, j, guide.path[last], cov, update, here)
        copy_into(guide.cov[j], cov)
        first = last
    return evidence if np.isfinite(evidence) else -np.inf


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
def _follow(system, record, beginning, guide):
    """Replace the path by the one along which the guide's mean noise leads; how far it moved."""
    n = system.n
    cov, last_state, moved = np.empty(n * (n + 1) // 2), np.empty(n), 0.0
    _guided_start(beginning, guide, cov)
    first = beginning.step
    for j in range(record.steps.size):
        last = record.steps[j]
        copy_into(last_state, guide.path[last])
        follow(system, first, last, record.t0, guide.path, guide.gains, guide.steps, cov)
        copy_into(guide.cov[j], cov)
        place = 0
        for a in range(n):
            move = guide.path[last, a] - last_state[a]
            if cov[place + a] > 0.0:
                moved = max(moved, move * move / cov[place + a])
            place += a + 1
        first = last
    return moved


@njit_internal
def _guided_start(beginning, guide, cov):
    """Begin the path at the mean of the guided start, and write its covariance."""
    first, mean, root = beginning
    n = mean.size
    place, spread = 1 + n + n * n, np.zeros((n, n))
    copy_into(guide.origin, guide.start[1 : 1 + n])
    for a in range(n):
        guide.path[first, a] = mean[a]
        for b in range(n):
            guide.path[first, a] += root[a, b] * guide.origin[b]
    for r in range(n):
        for c in range(r, n):
            for a in range(n):
                spread[a, c] += root[a, r] * guide.start[place]
            place += 1
    _cov_of(spread, cov)


@njit_internal
def _look_back(system, record, beginning, guide):
    """Compute psi, the gains and the start from the end of the record back to its beginning."""
    (begin, mean, root), n = beginning, system.n
    psi, here = np.zeros(n + n * (n + 1) // 2), new_information(n)
    address = system.look_back
    for j in range(record.steps.size - 1, -1, -1):
        last, first = record.steps[j], record.steps[j - 1] if j > 0 else begin
        copy_into(guide.psi[j + 1], psi)
        if not is_missing(record.observed, j):
            guide.sums[j, 0] = 0.0
            guide.sums[j, 1] = _add_observation(
                system, record, j, guide.path[last], guide.cov[j], here, psi
            )
        else:
            for i in range(2):
                guide.sums[j, i] = guide.sums[j + 1, i] if j + 1 < guide.sums.shape[0] else 0.0
        sums = guide.sums[j].ctypes.data
        look_back(address, first, last, guide.path, guide.steps, guide.gains, psi, sums)
    copy_into(guide.psi[0], psi)
    start, path = np.zeros(n + 2 * n * n + n + psi.size - n), np.zeros((2, n))
    for a in range(n):
        start[a] = mean[a]
        for b in range(n):
            start[a] += root[a, b] * guide.origin[b]
        start[2 * n * n + n + a] = guide.origin[a]
    copy_into(start[n + n * n : n + 2 * n * n], root.reshape(n * n))
    copy_into(path[1], guide.path[begin])
    zero, one = np.int64(0), np.int64(1)
    sums = np.zeros(2)
    look_back(system.start_back, zero, one, path, start, guide.start, psi, sums.ctypes.data)
    if record.steps.size:
        guide.sums[0, 1] += sums[1]


@njit_internal
def _add_observation(system, record, j, x, cov, here, psi):
    """Add the information of an observation to psi; its log-density on the path."""
    if not mean_information(system, record, j, x, cov, here):
        return -np.inf
    place = n = x.size
    for a in range(n):
        psi[a] += here.score[a]
        for b in range(a + 1):
            psi[place] += here.matrix[a, b]
            place += 1
    return here.row[0]


@njit_internal
def leave_unguided(gains, n, m):
    """Gains of noise that is not shifted."""
    gains[:] = 0.0
    place = 1 + m + m * n
    for r in range(m):
        gains[place] = 1.0
        place += m - r
