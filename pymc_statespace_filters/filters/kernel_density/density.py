"""Gaussian kernel density of weighted particles, in logs (thesis, Eqs. 4.36-4.39).

The density at a target v is sum_l w_l |H|^-1 K(H^-1 (x_l - v)), where H is the lower Cholesky
factor of the weighted covariance times N_eff^{-1/(n+4)}. Members and targets are whitened by H
first. In one and two directions the sums go through a grid (`gridded_sum`), O(N). In more
directions, for few members and for targets in the tails they are exact (`direct_sum`), O(N) per
target; the ranks divide the tails evenly, since all targets there may belong to one rank.

A direction in which the members do not spread at all (a state known exactly, or a copy of another)
is left out: all members and targets lie in the same subspace, and the density is the one on that
subspace, with n its dimension.

For importance weights, the forecast particles, moved by the Kalman update, are a sample of the
proposal. The density of the forecast (the prior) and that of the proposal are estimated from the
particles themselves.
"""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import inline_always, njit_internal
from ...compiler.numerics.normals import BLOCK
from ...compiler.numerics.restricted_domain import log
from ...compiler.numerics.small_cholesky import LOG_TWO_PI, semidefinite_cholesky
from ..ensemble.kalman_update import Moments, equal_weights, moments_workspace
from ..ensemble.reductions import (
    BLOCKS,
    MEMBERS,
    allgather,
    local_range,
    weighted_cov,
    weighted_mean,
)
from ..plan import log_density
from .direct_sum import Points, compact, complete_points, kernel_sum_workspace, log_kernel_sum
from .gridded_sum import FLOOR, gridded_sum_workspace, gridded_sums

_SQRT_HALF, _LOG_FLOOR = math.sqrt(0.5), math.log(FLOOR)
_KNOWN = 1e-13  # a smaller spread, relative to the mean, is rounding of a value known exactly
_LINE_FROM, _PLANE_FROM = 64, 256  # members from which a grid is at least twice as fast


@inline_always
def _uses_grid(n_active, n_members):
    minimum = _LINE_FROM if n_active == 1 else _PLANE_FROM
    return 1 <= n_active <= 2 and n_members >= minimum


def density_method(n_active, n_members):
    """Name of the summation for n_members particles that spread in n_active directions."""
    return "lattice" if _uses_grid.py_func(n_active, n_members) else "exact"


class Kernel(NamedTuple):
    """Moments and bandwidth of the members of a density.

    ``mean`` (n,) and ``cov`` (n, n) are those of all states; ``H`` (n_free, n_free) is the lower
    Cholesky factor of Eqs. 4.38 and 4.39 of the free states. ``active`` marks the directions with
    any spread.
    """

    mean: np.ndarray
    cov: np.ndarray
    H: np.ndarray
    active: np.ndarray


@njit_internal
def kernel_workspace(n, n_free):
    """A kernel to be filled by ``scott_bandwidth``."""
    return Kernel(
        np.empty(n), np.empty((n, n)), np.empty((n_free, n_free)), np.empty(n_free, np.bool_)
    )


@njit_internal
def density_workspace(local, n):
    """Scratch of ``log_kernel_density`` for n directions.

    The members and their weights, and the targets and the logs of their sums, of all ranks.
    """
    n_ranks, width = local.layout.n_ranks, BLOCK * local.sums.shape[1]
    sources = Points(np.empty((1 + n, width)), local.n_members, n_ranks == 1)
    targets = Points(np.empty((1 + n, width)), local.n_members, n_ranks == 1)
    exact, grid = kernel_sum_workspace(width), gridded_sum_workspace(n_ranks, width)
    # Indices of the targets in the tails, their number on each rank, and exact sums at them.
    tails = np.empty(width, np.int64), np.empty((1, n_ranks)), np.empty((1, width))
    return sources, targets, (exact, grid, tails)


@njit_internal
def scott_bandwidth(n_effective, free, kernel):
    """Fill ``H`` and ``active`` for the free states (Eqs. 4.38 and 4.39) from ``mean`` and ``cov``.

    Returns False if the moments are not finite.
    """
    H, n_active = kernel.H, 0
    floor = np.empty(free.size)
    for a in range(free.size):
        floor[a] = (_KNOWN * kernel.mean[free[a]]) ** 2
        for b in range(free.size):
            H[a, b] = kernel.cov[free[a], free[b]]
    if not semidefinite_cholesky(H, floor, kernel.active):
        return False
    for is_active in kernel.active:
        n_active += is_active
    scott = n_effective ** (-1.0 / (n_active + 4))
    for a in range(free.size):
        for b in range(a + 1):
            H[a, b] *= scott
    return True


@njit_internal
def _whiten(kernel, free, X, first, out):
    """Write H^-1 (X - mean) / sqrt(2) of the active directions to rows of ``out``, from 1 on.

    X fills the columns from ``first`` on. Returns the number of rows. The mean is subtracted
    because far from zero the rounding of x / h would swamp the distances between particles.
    """
    x_mean, H, active = kernel.mean, kernel.H, kernel.active
    n_rows, last = 0, first + X.shape[1]
    for a in range(active.size):
        if not active[a]:
            continue
        x, x_0 = X[free[a]], x_mean[free[a]]
        y = out[n_rows + 1, first:last]
        scale, before = 1.0 / H[a, a], 1
        for i in range(x.size):
            y[i] = (_SQRT_HALF * scale) * (x[i] - x_0)
        for b in range(a):
            if active[b]:
                coupling, z = scale * H[a, b], out[before, first:last]
                for i in range(x.size):
                    y[i] -= coupling * z[i]
                before += 1
        n_rows += 1
    return n_rows


@njit_internal
def _sum_exactly(layout, sources, targets, n_dims, first, logs, work):
    """Logs of the exact sums at the rank's targets, which begin at column ``first``."""
    complete_points(layout, sources, n_dims)
    y, v = sources.rows[1:], targets.rows[1:]
    n_blocks = compact(sources.rows[0, : sources.size], y, n_dims, work)
    for i in range(logs.size):
        logs[i] = log_kernel_sum(y, n_dims, n_blocks, v, first + i, work)


@njit_internal
def _has_tails(layout, targets, counts):
    """Replace the rank's sums by their logarithms; whether any target of any rank is in a tail."""
    start, end = local_range(layout, targets.size, MEMBERS)
    sums, n_missed = targets.rows[0, start:end], 0
    for i in range(sums.size):
        sums[i] = log(sums[i])
        n_missed += not sums[i] > _LOG_FLOOR
    counts[0, layout.rank] = n_missed
    allgather(layout, counts, BLOCKS)
    return counts.any()


@njit_internal
def _sum_tails(layout, sources, targets, n_dims, sum_work, tails):
    """Exact sums at the targets below the floor; afterwards every rank holds all sums."""
    missed, _, exact = tails
    complete_points(layout, sources, n_dims)
    complete_points(layout, targets, n_dims)
    logs, y, v, n_missed = targets.rows[0], sources.rows[1:], targets.rows[1:], 0
    for i in range(targets.size):
        if not logs[i] > _LOG_FLOOR:
            missed[n_missed] = i
            n_missed += 1
    n_blocks = compact(sources.rows[0, : sources.size], y, n_dims, sum_work)
    start, end = local_range(layout, n_missed, BLOCKS)
    for k in range(start, end):
        exact[0, k] = log_kernel_sum(y, n_dims, n_blocks, v, missed[k], sum_work)
    allgather(layout, exact[:, :n_missed], BLOCKS)
    for k in range(n_missed):
        logs[missed[k]] = exact[0, k]


@njit_internal
def log_gridded_sums(layout, sources, targets, n_dims, works):
    """log sum_l w_l exp(-|y_l - v_i|^2) at the rank's targets, in one or two directions.

    ``sources`` and ``targets`` are `Points`; the logs are written to the targets. Returns False if
    the grid would be too large.
    """
    sum_work, grid_work, tails = works
    if not gridded_sums(layout, sources, targets, n_dims, grid_work):
        return False
    if _has_tails(layout, targets, tails[1]):
        _sum_tails(layout, sources, targets, n_dims, sum_work, tails)
    return True


@njit_internal
def log_kernel_density(local, w, X, V, free, kernel, work, out):
    """Log-density at the columns of V of the particles X with normalised weights w.

    w, X and V are those of one rank; the density is that of the particles of all ranks. Members of
    zero weight are ignored and may be NaN. A target that is not finite gets -inf.
    """
    sources, targets, sums = work
    first, last = local.first, local.first + local.size
    local_w, logs = sources.rows[0, first:last], targets.rows[0, first:last]
    for i in range(w.size):
        local_w[i] = w[i]
    n_dims = _whiten(kernel, free, X, first, sources.rows)
    _whiten(kernel, free, V, first, targets.rows)
    if not (
        _uses_grid(n_dims, local.n_members)
        and log_gridded_sums(local.layout, sources, targets, n_dims, sums)
    ):
        _sum_exactly(local.layout, sources, targets, n_dims, first, logs, sums[0])
    log_kernel = 0.0
    for a in range(free.size):
        if kernel.active[a]:
            log_kernel -= math.log(kernel.H[a, a]) + 0.5 * LOG_TWO_PI
    for i in range(out.size):
        out[i] = logs[i] + log_kernel


class Scratch(NamedTuple):
    """Moments of the forecast, and scratch of the densities of Eq. 4.36."""

    moments: Moments
    w_equal: np.ndarray
    log_prior: np.ndarray
    log_proposal: np.ndarray
    density: tuple


@njit_internal
def importance_workspace(system, local):
    """Scratch of one update."""
    N, density = local.size, density_workspace(local, system.free.size)
    moments = moments_workspace(system.n, system.p)
    return Scratch(moments, np.empty(N), np.empty(N), np.empty(N), density)


@njit_internal
def reweight(system, k, t, d, members, forecast, n_effective, local, scratch):
    """Write the unnormalised log-weights of X to log_w and log p(d | x^a) to log_p.

    Returns False, with log_w unchanged, if proposal and forecast do not spread in the same
    directions.
    """
    X, w, log_w, log_p = members.X, members.w, members.log_w, members.log_p
    free, n, n_alive, w_equal = system.free, system.n, forecast.n_alive, scratch.w_equal
    kernel_f, kernel_a = kernel_workspace(n, free.size), kernel_workspace(n, free.size)
    equal_weights(members.alive, n_alive, w_equal)
    if not _set_bandwidths(
        members, forecast, n_effective, free, local, scratch, kernel_f, kernel_a
    ):
        return False
    log_density(system, k, t, d, X, log_p)
    log_prior, log_proposal, density = scratch.log_prior, scratch.log_proposal, scratch.density
    log_kernel_density(local, w, members.X_f, X, free, kernel_f, density, log_prior)
    log_kernel_density(local, w_equal, X, X, free, kernel_a, density, log_proposal)
    for i in range(w.size):
        log_weight = -math.log(n_alive) + log_p[i] + (log_prior[i] - log_proposal[i])
        log_w[i] = log_weight if members.alive[i] else -np.inf
    return True


@njit_internal
def _set_bandwidths(members, forecast, n_effective, free, local, scratch, kernel_f, kernel_a):
    X, X_f, w_equal = members.X, members.X_f, scratch.w_equal
    n_alive = forecast.n_alive
    weighted_mean(w_equal, X, 1.0, local, kernel_a.mean)
    for a in range(kernel_f.mean.size):
        kernel_f.mean[a] = scratch.moments.x_mean[a]
    spread_a = 1.0 - 1.0 / n_alive
    weighted_cov(w_equal, X, kernel_a.mean, X, kernel_a.mean, spread_a, local, kernel_a.cov)
    weighted_cov(
        members.w, X_f, kernel_f.mean, X_f, kernel_f.mean, forecast.spread, local, kernel_f.cov
    )
    return (
        scott_bandwidth(n_alive, free, kernel_a)  # Eq. 4.38
        and scott_bandwidth(n_effective, free, kernel_f)
        and _agree(kernel_a.active, kernel_f.active)
    )


@njit_internal
def _agree(spreads_a, spreads_f):
    """Whether two ensembles spread in the same directions."""
    for a in range(spreads_a.size):
        if spreads_a[a] != spreads_f[a]:
            return False
    return True
