"""Exact sum of weighted Gaussian kernels at one target, in logarithms, O(N).

Two passes over the members, in blocks of 64: the exponents and their maximum, then the sum of
exponentials relative to the maximum. The logarithm is finite for a target many bandwidths away from
every member.
"""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.numerics.normals import BLOCK
from ...compiler.numerics.restricted_domain import exp
from ..ensemble.reductions import HALVES, MEMBERS, allgather


class Points(NamedTuple):
    """Members and their weights, or targets and the sums at them.

    In the first ``size`` columns of ``rows`` (1 + n, width) the first row holds the weights or
    sums, the others the coordinates. A rank fills the columns of its members; ``known`` is True if
    this rank holds all columns from the start.
    """

    rows: np.ndarray
    size: int
    known: bool


@njit_internal
def complete_points(layout, points, n_dims):
    """Complete the weights or sums and the coordinates on every rank."""
    allgather(layout, points.rows[: 1 + n_dims], MEMBERS)


@njit_internal
def kernel_sum_workspace(width):
    """Scratch of ``compact`` and ``log_kernel_sum``."""
    return np.empty(width), np.empty(width), np.empty(BLOCK)


@njit_internal
def compact(w, sources, n_dims, work):
    """Move the members of positive weight to the front; return the number of their blocks."""
    log_w, _, _ = work
    n_sources = 0
    for i in range(w.size):
        if w[i] > 0.0:
            for a in range(n_dims):
                sources[a, n_sources] = sources[a, i]
            log_w[n_sources] = math.log(w[i])
            n_sources += 1
    n_blocks = -(-n_sources // BLOCK)
    for i in range(n_sources, n_blocks * BLOCK):
        for a in range(n_dims):
            sources[a, i] = 0.0
        log_w[i] = -np.inf
    return n_blocks


@njit_internal
def _exponents(sources, log_w, n_dims, first, targets, target, e):
    """e_l = log w_l - |y_l - v|^2 for a block of members, coordinates scaled by 1 / sqrt(2)."""
    for i in range(BLOCK):
        e[i] = log_w[first + i]
    for a in range(n_dims):
        y, v = sources[a, first : first + BLOCK], targets[a, target]
        for i in range(BLOCK):
            e[i] -= (y[i] - v) * (y[i] - v)


@njit_internal
def log_kernel_sum(sources, n_dims, n_blocks, targets, target, work):
    """log sum_l w_l exp(-|y_l - v|^2); -inf for a target that is not finite."""
    log_w, exponents, lane = work
    for i in range(BLOCK):
        lane[i] = -np.inf
    for block in range(n_blocks):
        first = block * BLOCK
        e = exponents[first : first + BLOCK]
        _exponents(sources, log_w, n_dims, first, targets, target, e)
        for i in range(BLOCK):
            lane[i] = e[i] if e[i] > lane[i] else lane[i]
    for half in HALVES:
        for i in range(half):
            lane[i] = lane[half + i] if lane[half + i] > lane[i] else lane[i]
    largest = lane[0]
    if not largest > -np.inf:
        return -np.inf
    for i in range(BLOCK):
        lane[i] = 0.0
    for block in range(n_blocks):
        e = exponents[block * BLOCK : (block + 1) * BLOCK]
        for i in range(BLOCK):
            lane[i] += exp(e[i] - largest)
    for half in HALVES:
        for i in range(half):
            lane[i] += lane[half + i]
    return largest + math.log(lane[0])
