"""Particles that a guide moves: noise, weights, and resampling in front of an interval."""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import njit_internal
from ..plan import initialise, propagate_guided
from .callbacks import FORECAST, emit
from .defence import mixture_weight, undo_guide
from .loop import Members, new_members
from .noise import process_normals, process_rows
from .reductions import FIRST_ROW, allgather_sums, sum_squares, total
from .resampling import resample
from .weights import normalise_weights

_NUMBER_BYTES = 8


class GuidedParticles(NamedTuple):
    """Members, with what guided moves add to them.

    ``log_ratio`` (N,) follows the states in memory: the log density ratios of moves since they were
    last added to the weights. ``log_det`` (1,) is their common term. ``log_v`` and ``v`` (N,) are
    the weights times psi, ``start`` (n, width) the normals of the start, shifted by the guide.
    ``unguided`` (N,) are the particles that the guide does not move, if there is a share of them.
    ``normals`` (m, width) is scratch.
    """

    members: Members
    log_ratio: np.ndarray
    log_det: np.ndarray
    log_v: np.ndarray
    v: np.ndarray
    start: np.ndarray
    unguided: np.ndarray
    normals: np.ndarray


@njit_internal
def guided_particles(n, m, p, local):
    """Particles of n states, m noises and p observables, with room for what moves them."""
    rows = np.empty((n + 1, local.size))
    rows[n] = 0.0
    members = new_members(rows[:n], p, local)
    N = local.size
    return GuidedParticles(
        members=members, log_ratio=rows[n], log_det=np.zeros(1), log_v=np.empty(N), v=np.empty(N),
        start=np.empty((n, local.width)), unguided=np.zeros(N, np.bool_),
        normals=np.empty((m, local.width)),
    )  # fmt: skip


@njit_internal
def start(system, guide, given, share, particles, local):
    """Draw the states at step 0 from normals (n, width), shifted by the guide.

    What it does to the weights counts as a move of the first interval.
    """
    n, N = system.n, local.size
    shifted, log_ratio = particles.start, particles.log_ratio
    if share > 0.0:
        normals = np.empty((n, local.width))
        undo_guide(guide.start[1:], np.zeros((n, N)), given, particles.unguided, normals)
        given = normals
    place = 1 + n + n * n
    for r in range(n):
        for i in range(N):
            value = guide.start[1 + r]
            for c in range(r, n):
                value += guide.start[place + c - r] * given[c, i]
            shifted[r, i] = value
            log_ratio[i] += 0.5 * (given[r, i] * given[r, i] - value * value)
        place += n - r
    particles.log_det[0] += guide.start[0]
    initialise(system, shifted.ctypes.data, local.width, particles.members.X)


@njit_internal
def weigh_moves(particles, share, out):
    """Add the density ratios of the moves to the weights, in ``out``.

    ``share`` is the probability to be unguided.
    """
    log_w, log_ratio, log_det = particles.members.log_w, particles.log_ratio, particles.log_det[0]
    if share == 0.0:
        for i in range(log_w.size):
            out[i] = log_w[i] + (log_ratio[i] + log_det)
    else:
        for i in range(log_w.size):
            out[i] = log_w[i] + mixture_weight(log_ratio[i] + log_det, share)


@njit_internal
def begin_interval(particles):
    """Forget the density ratios of earlier moves."""
    for i in range(particles.log_ratio.size):
        particles.log_ratio[i] = 0.0
    particles.log_det[0] = 0.0


@njit_internal
def log_psi(guide, j, k, X, out):
    """Write log psi of every particle after observation j, without its constant."""
    n, N = guide.path.shape[1], out.size
    x, psi, place = guide.path[k], guide.psi[j], n
    for i in range(N):
        out[i] = 0.0
    for a in range(n):
        for b in range(a):
            for i in range(N):
                out[i] -= psi[place] * (X[a, i] - x[a]) * (X[b, i] - x[b])
            place += 1
        for i in range(N):
            out[i] += (psi[a] - 0.5 * psi[place] * (X[a, i] - x[a])) * (X[a, i] - x[a])
        place += 1


@njit_internal
def look_ahead(guide, j, k, share, particles, local):
    """Weigh the particles by psi; the log of the sum of w psi, and an effective number.

    It is that of the probabilities of `resample_ahead`, of which a ``share`` is w alone.
    """
    members, log_v, v = particles.members, particles.log_v, particles.v
    log_psi(guide, j, k, members.X, log_v)
    for i in range(log_v.size):
        log_v[i] = members.log_w[i] + log_v[i] if members.alive[i] else -np.inf
    log_total, n_effective = normalise_weights(log_v, v, local)
    if share > 0.0:
        for i in range(v.size):
            v[i] = (1.0 - share) * v[i] + share * members.w[i]
        sum_squares(v, local, FIRST_ROW)
        allgather_sums(local, FIRST_ROW + 1)
        n_effective = 1.0 / total(local, FIRST_ROW)
    return log_total, n_effective


@njit_internal
def resample_ahead(guide, j, k, log_total, resampling, z, share, particles, local):
    """Draw particles in proportion to w psi, whose sum is given, and divide their weights by it.

    Of the probability a ``share``, which may be zero, is that of w alone, as `look_ahead` left it.
    """
    log_w, log_v = particles.members.log_w, particles.log_v
    resample(resampling, z, particles.v, particles.members.X, local)
    log_psi(guide, j, k, particles.members.X, log_v)
    for i in range(log_w.size):
        log_ratio = log_total - log_v[i]
        if share > 0.0:
            log_ratio = mixture_weight(log_ratio, share)
        log_w[i] = log_ratio - math.log(local.n_members)


@njit_internal
def move(system, guide, record, noise, first, last, share, particles, local):
    """Move the particles from one step to another, a share of them without the guide."""
    X, gains, log_det = particles.members.X, guide.gains, 0.0
    row = np.int64(gains.ctypes.data) + _NUMBER_BYTES * (first * gains.shape[1] + 1)
    for k in range(first, last):
        t, z = record.t0 + k * system.dt, process_normals(noise, k)
        if share > 0.0:
            normals = process_rows(noise, k)
            undo_guide(gains[k, 1:], X, normals, particles.unguided, particles.normals)
            z = np.int64(particles.normals.ctypes.data)
        propagate_guided(system, k, t, z, local.width, X, row)
        row += _NUMBER_BYTES * gains.shape[1]
        log_det += gains[k, 0]
    particles.log_det[0] += log_det


@njit_internal
def emit_forecast(callback, j, k, share, particles, nothing, ancestors):
    """Show the particles with the weights that their moves have left them."""
    if callback[0] == 0:
        return
    members, log_v = particles.members, particles.log_v
    weigh_moves(particles, share, log_v)
    shown = Members(
        X=members.X, D=members.D, X_f=members.X_f, w=members.w, log_w=log_v, log_p=members.log_p,
        alive=members.alive,
    )  # fmt: skip
    emit(callback, FORECAST, j, k, shown, nothing, ancestors)
