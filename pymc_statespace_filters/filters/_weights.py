"""Weights of particles, kept as logarithms."""

import math

import numpy as np

from pymc_statespace_filters.filters._compile import compiled, reducing
from pymc_statespace_filters.filters._elementary import EXP_LOWEST, exp


@compiled
def log_sum(log_a, log_b):
    """log sum_i exp(log_a_i + log_b_i), in which NaN and +inf count as zero."""
    largest = -np.inf
    for i in range(log_a.size):
        value = log_a[i] + log_b[i]
        if value > largest and value < np.inf:
            largest = value
    if largest == -np.inf:
        return -np.inf
    total = 0.0
    for i in range(log_a.size):
        value = log_a[i] + log_b[i]
        if value < np.inf:
            total += exp(value - largest)
    return largest + math.log(total)


@compiled
def normalise(log_w, w):
    """Make w and log_w the normalised weights; return the log of their former sum.

    NaN and +inf are weights of zero. If every weight is zero the result is -inf and the weights are
    useless.
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
        above = log_w[i] - largest
        w[i] = exp(above) if above > EXP_LOWEST else 0.0
        total += w[i]
    log_total = largest + math.log(total)
    for i in range(w.size):
        w[i] /= total
        log_w[i] -= log_total
    return log_total


@reducing
def effective_number(w):
    """1 / sum w^2 of normalised weights (thesis, Eq. 4.43)."""
    total = 0.0
    for i in range(w.size):
        total += w[i] * w[i]
    return 1.0 / total
