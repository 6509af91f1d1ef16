"""Weights of particles, stored as logarithms.

Sums over all ranks use `reductions`: the weights of a block are taken relative to the largest of
that block, and the blocks are then rescaled, so that one exchange is enough.
"""

import math

import numpy as np

from ...compiler.native.jit import njit_internal, njit_reassoc
from ...compiler.numerics.normals import BLOCK
from ...compiler.numerics.restricted_domain import EXP_LOWEST, exp
from .reductions import FIRST_ROW, HALVES, allgather_sums, sum_squares, sum_values


@njit_internal
def normalise(log_w, w):
    """Normalise log_w and write the weights to w; return the log of their former sum.

    NaN and +inf count as zero weights. If every weight is zero the result is -inf and w is
    undefined.
    """
    largest = -np.inf
    for i in range(log_w.size):
        if not log_w[i] < np.inf:
            log_w[i] = -np.inf
        if log_w[i] > largest:
            largest = log_w[i]
    if largest == -np.inf:
        return -np.inf
    total = 0.0
    for i in range(w.size):
        w[i] = _relative(log_w[i], largest)
        total += w[i]
    log_total = largest + math.log(total)
    for i in range(w.size):
        w[i] /= total
        log_w[i] -= log_total
    return log_total


@njit_reassoc
def effective_number(w):
    """1 / sum w^2 of normalised weights (thesis, Eq. 4.43)."""
    total = 0.0
    for i in range(w.size):
        total += w[i] * w[i]
    return 1.0 / total


@njit_internal
def weigh(log_w, w, local, row):
    """Write to w the weights relative to the largest of their block, and three rows of sums.

    The rows, for `total_weight`: the log of the largest weight, and the sums of w and of w^2. NaN
    and +inf count as zero weights and become -inf in log_w.
    """
    n_whole, out = w.size // BLOCK, local.sums[row, local.first_block :]
    for block in range(n_whole):  # a loop of fixed length becomes straight vector code
        out[block] = _weigh_block(log_w, w, BLOCK * block, BLOCK, local.lanes)
    if BLOCK * n_whole < w.size:
        first = BLOCK * n_whole
        out[n_whole] = _weigh_block(log_w, w, first, w.size - first, local.lanes)
    sum_values(w, local, row + 1)
    sum_squares(w, local, row + 2)


@njit_internal
def _weigh_block(log_w, w, first, n, lanes):
    """Write n weights relative to the largest of them; return its logarithm."""
    log_block, w_block = log_w[first : first + n], w[first : first + n]
    for i in range(n, BLOCK):
        lanes[i] = -np.inf
    for i in range(n):
        value = log_block[i] if log_block[i] < np.inf else -np.inf
        log_block[i] = lanes[i] = value
    for half in HALVES:
        for i in range(half):
            lanes[i] = lanes[half + i] if lanes[half + i] > lanes[i] else lanes[i]
    largest = lanes[0]
    for i in range(n):
        w_block[i] = _relative(log_block[i], largest)
    return largest


@njit_internal
def _relative(log_w, largest):
    difference = log_w - largest
    return exp(difference) if difference > EXP_LOWEST else 0.0


@njit_internal
def total_weight(local, row):
    """Log of the sum of all weights, and their effective number (thesis, Eq. 4.43).

    From three completed rows of `weigh`; -inf and 0 if every weight is zero. The first row is
    replaced by the factors that normalise the weights of each block.
    """
    scales, sums, squares = local.sums[row], local.sums[row + 1], local.sums[row + 2]
    largest = -np.inf
    for block in range(scales.size):
        if scales[block] > largest:
            largest = scales[block]
    if largest == -np.inf:
        return -np.inf, 0.0
    all_weight, all_squares = 0.0, 0.0
    for block in range(scales.size):
        scale = _relative(scales[block], largest)
        scales[block] = scale
        all_weight += scale * sums[block]
        all_squares += scale * scale * squares[block]
    for block in range(scales.size):
        scales[block] /= all_weight
    return largest + math.log(all_weight), all_weight * all_weight / all_squares


@njit_internal
def normalise_local(log_total, log_w, w, local, row):
    """Normalise a rank's own w and log_w after `total_weight`, which returned ``log_total``."""
    for first in range(0, w.size, BLOCK):
        scale = local.sums[row, local.first_block + first // BLOCK]
        for i in range(first, min(first + BLOCK, w.size)):
            w[i] *= scale
    for i in range(w.size):
        log_w[i] -= log_total


@njit_internal
def normalise_weights(log_w, w, local):
    """Make w and log_w the normalised weights of all members.

    Returns the log of their former sum and their effective number (thesis, Eq. 4.43). NaN and +inf
    are weights of zero. If every weight is zero, the log is -inf and the weights are useless.
    """
    weigh(log_w, w, local, FIRST_ROW)
    allgather_sums(local, FIRST_ROW + 3)
    log_total, n_effective = total_weight(local, FIRST_ROW)
    if log_total > -np.inf:
        normalise_local(log_total, log_w, w, local, FIRST_ROW)
    return log_total, n_effective
