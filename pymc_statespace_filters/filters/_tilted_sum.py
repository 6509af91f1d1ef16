"""Lattice sums where the targets are: over the cloud of members, or far outside, O(N).

For any shift t of the targets

    w_l exp(-|y_l - v|^2) = [w_l exp(2 t.y_l)] exp(-|y_l - (v - t)|^2) exp(t.(t - 2 v)),

so sums at far targets are sums at near ones, with other weights. The shift moves the mean of the
targets onto the mean of the members that matter there, each in proportion to its term of the sum.
First all targets are tried as they are, then, if many are left, these are shifted.
"""

import math

import numpy as np

from pymc_statespace_filters.filters._compile import compiled, pasted
from pymc_statespace_filters.filters._elementary import exp, log
from pymc_statespace_filters.filters._kernel_sum import compact, log_kernel_sum
from pymc_statespace_filters.filters._lattice_sum import FLOOR, lattice_sums

_LOG_FLOOR = math.log(FLOOR)
_FEW = 64  # exact sums that cost less than another lattice; both grow with the number of members


@compiled
def tilted_workspace(n, width):
    """Scratch of ``log_lattice_sums``: shifted targets, weights, sums, and the shift."""
    return np.empty((n, width)), np.empty(width), np.empty(width), np.empty(n)


@pasted
def _collect(sums, targets, n_dims, shift, log_total, missed, out):
    """Logs of the sums above the floor; the others stay in ``missed``. Return how many."""
    for k in range(sums.size):
        sums[k] = log(sums[k])
    n_left = 0
    for k in range(sums.size):
        i = missed[k]
        value = log_total + sums[k]
        for a in range(n_dims):
            value += shift[a] * (shift[a] - 2.0 * targets[a, i])
        out[i] = value
        if not sums[k] > _LOG_FLOOR:
            missed[n_left] = i
            n_left += 1
    return n_left


@compiled
def _choose_shift(sources, n_dims, members, targets, missed, sum_work, shifted, shift):
    """The shift for the targets ``missed``; False if none of them is finite."""
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


@pasted
def _tilt(sources, n_dims, n_sources, log_w, shift, weights):
    """Leave w_l exp(2 t.y_l), normalised, in ``weights``; return the log of their sum."""
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


@pasted
def log_lattice_sums(w, sources, targets, n_dims, works, missed, out):
    """log sum_l w_l exp(-|y_l - v_i|^2) for the columns of ``targets``, in one or two directions.

    Returns how many targets it leaves out, their indices at the front of ``missed``, and what
    ``compact`` returned, or zeros if it was not needed.
    """
    members = np.int64(0), np.int64(0)
    sum_work, lattice_work, (shifted, tilted, all_sums, shift) = works
    n_missed, log_total, weights, at = out.size, 0.0, w, targets
    for i in range(n_missed):
        missed[i] = i
    for a in range(n_dims):
        shift[a] = 0.0
    for attempt in range(2):
        left, sums = missed[:n_missed], all_sums[:n_missed]
        if attempt == 1:
            members = compact(w, sources, n_dims, sum_work)
            if not _choose_shift(sources, n_dims, members, targets, left, sum_work, shifted, shift):
                break
            log_total = _tilt(sources, n_dims, members[0], sum_work[0], shift, tilted)
            weights, at = tilted[: members[0]], shifted
            for a in range(n_dims):
                for k in range(n_missed):
                    shifted[a, k] = targets[a, left[k]] - shift[a]
        if not lattice_sums(weights, sources, at, n_dims, lattice_work, sums):
            break
        n_missed = _collect(sums, targets, n_dims, shift, log_total, left, out)
        if n_missed <= _FEW:
            break
    return n_missed, members
