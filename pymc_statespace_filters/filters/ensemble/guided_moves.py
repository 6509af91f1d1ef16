"""Particles that a guide moves: noise, weights, and resampling in front of an interval."""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import inline_always, keep_alive, njit_internal
from ..plan import initialise, propagate_guided
from .callbacks import FORECAST
from .defence import choose_unguided, mixture_weight, place_of_unguided, undo_guide
from .evaluation import Members, members_with, show
from .guide import leave_unguided
from .noise import initial_rows, process_normals, process_rows, resampling_normals
from .reductions import FIRST_ROW, allgather_sums, sum_squares, total
from .resampling import resample
from .weights import normalise_weights

_NUMBER_BYTES = 8


class GuidedParticles(NamedTuple):
    """Members, what guided moves add to them, and what they need of the guide.

    The members' ``behind`` are the log density ratios of moves since they were last added to the
    weights; ``log_det`` (1,) is the common term. ``log_v`` and ``v`` (N,) are the weights times
    psi. ``unguided`` (N,) are the particles that the guide does not move, if there is a share of
    them; ``normals`` (m, width) is scratch. ``path``, ``gains`` and ``psi`` are the `Guide`'s.
    ``shares`` (J + 1,) are those of unguided particles in front of every observation and behind the
    last, ``ahead`` (2,) that of the present interval and the log of the sum of w psi. ``copies``
    (n + 1, N), where they are followed, are particles without guidance, their weights
    ``copies_log_w``, and ``plain`` the gains of a step without it, see `guided_predictions`.

    All is in one tuple: each that is passed on costs some nanoseconds for each array in it.
    """

    members: Members
    log_det: np.ndarray
    log_v: np.ndarray
    v: np.ndarray
    unguided: np.ndarray
    normals: np.ndarray
    path: np.ndarray
    gains: np.ndarray
    psi: np.ndarray
    shares: np.ndarray
    ahead: np.ndarray
    copies: np.ndarray
    copies_log_w: np.ndarray
    plain: np.ndarray


@njit_internal
def guided_particles(call, members, guide, shares):
    """Particles with room for what moves them."""
    N, n, m = call.local.size, call.system.n, call.system.m
    plain, size = np.zeros(guide.gains.shape[1]), N if call.observer[0] != 0 else 0
    leave_unguided(plain, n, m)
    return GuidedParticles(
        members=members, log_det=np.zeros(1), log_v=np.empty(N), v=np.empty(N),
        unguided=np.zeros(N, np.bool_), normals=np.empty((m, call.local.width)), path=guide.path,
        gains=guide.gains, psi=guide.psi, shares=shares, ahead=np.zeros(2),
        copies=np.zeros((n + 1, size)), copies_log_w=np.empty(size), plain=plain,
    )  # fmt: skip


@njit_internal
def draw_start(call, guide, share, particles):
    """Draw the states at step 0 by normals that the guide shifts.

    What it does to the weights counts as a move of the first interval.
    """
    n, N, local, given = call.system.n, call.local.size, call.local, initial_rows(call.noise)
    shifted, log_ratio = np.empty((n, local.width)), particles.members.behind
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
    initialise(call.system, shifted.ctypes.data, local.width, particles.members.X)
    keep_alive(shifted)


@inline_always
def weigh_moves(particles, out):
    """Add the density ratios of the moves to the weights, in ``out``."""
    members, log_det, share = particles.members, particles.log_det[0], particles.ahead[0]
    log_w, log_ratio = members.log_w, members.behind
    if share == 0.0:
        for i in range(log_w.size):
            out[i] = log_w[i] + (log_ratio[i] + log_det)
    else:
        for i in range(log_w.size):
            out[i] = log_w[i] + mixture_weight(log_ratio[i] + log_det, share)


@njit_internal
def begin_interval(particles):
    """Forget the density ratios of earlier moves."""
    log_ratio = particles.members.behind
    for i in range(log_ratio.size):
        log_ratio[i] = 0.0
    particles.log_det[0] = 0.0


@njit_internal
def log_psi(particles, j, k, X, out):
    """Write log psi of every particle in front of observation j, without its constant."""
    n, N = X.shape[0], out.size
    x, psi, place = particles.path[k], particles.psi[j], n
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


@inline_always
def look_ahead(call, j, k, particles):
    """Weigh the particles by psi in front of observation j; an effective number.

    It is that of the probabilities of `resample_ahead`, of which a share is w alone.
    """
    members, log_v, v, local = particles.members, particles.log_v, particles.v, call.local
    share = particles.ahead[0] = particles.shares[j]
    log_psi(particles, j, k, members.X, log_v)
    for i in range(log_v.size):
        log_v[i] = members.log_w[i] + log_v[i] if members.alive[i] else -np.inf
    particles.ahead[1], n_effective = normalise_weights(log_v, v, local)
    if share > 0.0:
        for i in range(v.size):
            v[i] = (1.0 - share) * v[i] + share * members.w[i]
        sum_squares(v, local, FIRST_ROW)
        allgather_sums(local, FIRST_ROW + 1)
        n_effective = 1.0 / total(local, FIRST_ROW)
    return n_effective


@njit_internal
def resample_ahead(call, j, k, particles):
    """Draw particles in proportion to w psi in front of observation j; divide their weights by it.

    Of the probability a share, which may be zero, is that of w alone, as `look_ahead` left it.
    """
    log_w, log_v, local = particles.members.log_w, particles.log_v, call.local
    share, log_total = particles.ahead
    z = resampling_normals(call.noise, j - 1, k)
    choose_unguided(share, place_of_unguided(z), local.first, particles.unguided)
    resample(call.resampling, z, particles.v, particles.members.X, local)
    log_psi(particles, j, k, particles.members.X, log_v)
    for i in range(log_w.size):
        log_ratio = log_total - log_v[i]
        if share > 0.0:
            log_ratio = mixture_weight(log_ratio, share)
        log_w[i] = log_ratio - math.log(local.n_members)


@inline_always
def move(call, first, last, particles):
    """Move the particles from one step to another, a share of them without the guide."""
    system, noise, X, gains = call.system, call.noise, particles.members.X, particles.gains
    t0, dt, width, log_det = call.record.t0, system.dt, call.local.width, 0.0
    share = particles.ahead[0]
    row = np.int64(gains.ctypes.data) + _NUMBER_BYTES * (first * gains.shape[1] + 1)
    for k in range(first, last):
        z = process_normals(noise, k)
        if share > 0.0:
            normals = process_rows(noise, k)
            undo_guide(gains[k, 1:], X, normals, particles.unguided, particles.normals)
            z = np.int64(particles.normals.ctypes.data)
        propagate_guided(system, k, t0 + k * dt, z, width, X, row)
        row += _NUMBER_BYTES * gains.shape[1]
        log_det += gains[k, 0]
    particles.log_det[0] += log_det


@njit_internal
def show_forecast(call, j, k, particles):
    """Show the particles with the weights that their moves have left them."""
    members, log_v = particles.members, particles.log_v
    weigh_moves(particles, log_v)
    show(call, FORECAST, j, k, members_with(members, members.X, log_v), call.nothing)
