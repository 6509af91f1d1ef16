"""Gridded kernel sums at targets in the cloud of members and far outside it, O(N).

For any shift t of the targets

    w_l exp(-|y_l - v|^2) = [w_l exp(2 t.y_l)] exp(-|y_l - (v - t)|^2) exp(t.(t - 2 v)),

so a sum at a far target is a sum at a near one with other weights (an exponential tilt). The shift
moves the mean of the targets onto the mean of the members weighted by their terms of the sum.

All targets are tried without a shift first; if many are below the floor, these are shifted; the
rest is summed exactly. The ranks divide the last two steps evenly, since all targets in the tails
may belong to one rank.
"""

import math

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.numerics.restricted_domain import exp, log
from ..ensemble.reductions import BLOCKS, MEMBERS, allgather, local_range
from .direct_sum import Points, compact, complete_points, log_kernel_sum
from .gridded_sum import FLOOR, gridded_sums

_LOG_FLOOR = math.log(FLOOR)
_FEW = 64  # so many exact sums cost less than another grid; both costs are O(N)


@njit_internal
def shifted_sum_workspace(n_ranks, n, width):
    """Scratch of ``log_gridded_sums``.

    Indices of the targets below the floor and their number on each rank; these targets shifted, and
    the shift; exact sums.
    """
    missed, counts = np.empty(width, np.int64), np.empty((1, n_ranks))
    return missed, counts, np.empty((1 + n, width)), np.empty(n), np.empty((1, width))


@njit_internal
def _take_logs(layout, targets):
    """Replace the rank's sums by their logarithms; return how many are below the floor."""
    start, end = local_range(layout, targets.size, MEMBERS)
    sums, n_missed = targets.rows[0, start:end], 0
    for i in range(sums.size):
        sums[i] = log(sums[i])
        n_missed += not sums[i] > _LOG_FLOOR
    return n_missed


@njit_internal
def _total(layout, counts, count):
    counts[0, layout.rank] = count
    allgather(layout, counts, BLOCKS)
    total = 0.0
    for rank in range(counts.size):
        total += counts[0, rank]
    return np.int64(total)


@njit_internal
def _choose_shift(sources, n_dims, members, targets, missed, sum_work, shifted, shift):
    """Find the shift for the targets ``missed``; False if none of them is finite."""
    n_sources, n_blocks = members
    for a in range(n_dims):
        total, count = 0.0, 0
        for i in missed:
            if np.isfinite(targets[a, i]):
                total += targets[a, i]
                count += 1
        if count == 0:
            return False
        shifted[a, 0] = total / count
    log_total = log_kernel_sum(sources, n_dims, n_blocks, shifted, np.int64(0), sum_work)
    exponents = sum_work[1]
    for a in range(n_dims):
        member_mean = 0.0
        for i in range(n_sources):
            member_mean += exp(min(exponents[i] - log_total, 0.0)) * sources[a, i]
        shift[a] = shifted[a, 0] - member_mean
    return np.isfinite(log_total)


@njit_internal
def _shift_weights(sources, n_dims, n_sources, log_w, shift, weights):
    """Write w_l exp(2 t.y_l), normalised, to ``weights``; return the log of their sum."""
    largest = -np.inf
    for i in range(n_sources):
        weights[i] = log_w[i]
        for a in range(n_dims):
            weights[i] += 2.0 * shift[a] * sources[a, i]
        largest = max(largest, weights[i])
    total = 0.0
    for i in range(n_sources):
        weights[i] = exp(weights[i] - largest)
        total += weights[i]
    for i in range(n_sources):
        weights[i] /= total
    return largest + math.log(total)


@njit_internal
def _sum_shifted(layout, members, sources, targets, n_missed, n_dims, works):
    """Sums at shifted targets; return how many targets are still below the floor."""
    sum_work, grid_work, (missed, _, shifted, shift, _) = works
    y, v, some = sources.rows[1:], targets.rows[1:], missed[:n_missed]
    if not _choose_shift(y, n_dims, members, v, some, sum_work, shifted[1:], shift):
        return n_missed
    log_total = _shift_weights(y, n_dims, members[0], sum_work[0], shift, sources.rows[0])
    for a in range(n_dims):
        for k in range(n_missed):
            shifted[1 + a, k] = v[a, some[k]] - shift[a]
    shifted_sources, at = Points(sources.rows, members[0], True), Points(shifted, n_missed, True)
    if not gridded_sums(layout, shifted_sources, at, n_dims, grid_work):
        return n_missed
    _take_logs(layout, at)
    allgather(layout, shifted[:1, :n_missed], MEMBERS)
    n_left = 0
    for k in range(n_missed):
        i, log_sum = some[k], shifted[0, k]
        value = log_total + log_sum
        for a in range(n_dims):
            value += shift[a] * (shift[a] - 2.0 * v[a, i])
        targets.rows[0, i] = value
        if not log_sum > _LOG_FLOOR:
            missed[n_left] = i
            n_left += 1
    return n_left


@njit_internal
def _sum_tails(layout, sources, targets, n_dims, works):
    """Sums at the targets below the floor; afterwards every rank holds all sums."""
    sum_work, _, (missed, _, _, _, exact) = works
    complete_points(layout, sources, n_dims)
    complete_points(layout, targets, n_dims)
    logs, y, v = targets.rows[0], sources.rows[1:], targets.rows[1:]
    n_missed = np.int64(0)  # for a literal 0 numba would compile `_sum_shifted` once more
    for i in range(targets.size):
        if not logs[i] > _LOG_FLOOR:
            missed[n_missed] = i
            n_missed += 1
    members = compact(sources.rows[0, : sources.size], y, n_dims, sum_work)
    if n_missed > _FEW:
        n_missed = _sum_shifted(layout, members, sources, targets, n_missed, n_dims, works)
    if n_missed == 0:
        return
    start, end = local_range(layout, n_missed, BLOCKS)
    for k in range(start, end):
        exact[0, k] = log_kernel_sum(y, n_dims, members[1], v, missed[k], sum_work)
    allgather(layout, exact[:, :n_missed], BLOCKS)
    for k in range(n_missed):
        logs[missed[k]] = exact[0, k]


@njit_internal
def log_gridded_sums(layout, sources, targets, n_dims, works):
    """log sum_l w_l exp(-|y_l - v_i|^2) at the rank's targets, in one or two directions.

    ``sources`` and ``targets`` are `Points`; the logs are written to the targets. Returns False if
    the grid would be too large.
    """
    _, grid_work, (_, counts, _, _, _) = works
    if not gridded_sums(layout, sources, targets, n_dims, grid_work):
        return False
    if _total(layout, counts, _take_logs(layout, targets)) > 0:
        _sum_tails(layout, sources, targets, n_dims, works)
    return True
