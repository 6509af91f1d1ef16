"""Gaussian kernel density of weighted particles, exact, O(N^2), in logs (thesis, Eqs. 4.36-4.39).

The density at a target v is sum_l w_l |H|^-1 K(H^-1 (x_l - v)), where H is the lower Cholesky
factor of the weighted covariance times N_eff^{-1/(n+4)}. Members and targets are whitened by H
first, so that the double loop sees plain distances. It makes two passes over blocks of 64 targets:
the largest exponent of each target, then the sum of exponentials relative to it. So a target many
bandwidths away from every member still has its finite log-density.

A direction in which the members do not spread at all (a state known exactly, or a copy of another)
is left out: all members and all targets lie in the same subspace, and the density is the one on it,
n its dimension.
"""

import math

import numpy as np

from pymc_statespace_filters.filters._compile import compiled, pasted
from pymc_statespace_filters.filters._elementary import exp
from pymc_statespace_filters.filters._ensemble import count_true, covariance, mean
from pymc_statespace_filters.filters._gaussian import LOG_TWO_PI, semidefinite_cholesky
from pymc_statespace_filters.filters._random import BLOCK

_SQRT_HALF = math.sqrt(0.5)
_KNOWN = 1e-13  # a spread below this share of the mean is rounding noise of a value known exactly


@compiled
def density_workspace(n, width):
    """Scratch of ``log_kernel_density`` for n directions and a padded number of members."""
    sources, targets = np.empty((n, width)), np.zeros((n, width))
    return sources, targets, np.empty(width), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)


@compiled
def scott_bandwidth(w, n_effective, X, free, x_mean, P, H, active):
    """Lower Cholesky factor H of the bandwidth of the free states (Eqs. 4.38 and 4.39).

    H is (n_free, n_free); x_mean (n,) and P (n, n) are scratch. ``active`` (n_free,) is False for
    directions without spread. Returns False if the moments are not finite.
    """
    mean(w, X, x_mean)
    covariance(w, X, x_mean, X, x_mean, P)
    floor = np.empty(free.size)
    for a in range(free.size):
        floor[a] = (_KNOWN * x_mean[free[a]]) ** 2
        for b in range(free.size):
            H[a, b] = P[free[a], free[b]]
    if not semidefinite_cholesky(H, floor, active):
        return False
    scott = n_effective ** (-1.0 / (count_true(active) + 4))
    for a in range(free.size):
        for b in range(a + 1):
            H[a, b] *= scott
    return True


@pasted
def _whiten(H, active, free, X, i, out, column):
    """Write H^-1 x_i / sqrt(2) into a column; zero in the directions that are left out."""
    for a in range(active.size):
        out[a, column] = 0.0
        if active[a]:
            value = _SQRT_HALF * X[free[a], i]
            for b in range(a):
                value -= H[a, b] * out[b, column]
            out[a, column] = value / H[a, a]


@pasted
def _half_squares(sources, targets, member, first, q):
    """q_i = |y - v_i|^2 / 2 for one member and the 64 targets from ``first``."""
    for a in range(sources.shape[0]):
        y, v = sources[a, member], targets[a, first : first + BLOCK]
        if a == 0:
            for i in range(BLOCK):
                q[i] = (y - v[i]) * (y - v[i])
        else:
            for i in range(BLOCK):
                q[i] += (y - v[i]) * (y - v[i])


@pasted
def _density_block(sources, targets, log_w, n_sources, first, q, largest, total):
    """Log of sum_l w_l exp(-|y_l - v_i|^2 / 2) for 64 targets, left in ``total``."""
    for i in range(BLOCK):
        largest[i] = -np.inf
        total[i] = 0.0
    for member in range(n_sources):
        _half_squares(sources, targets, member, first, q)
        for i in range(BLOCK):
            exponent = log_w[member] - q[i]
            largest[i] = exponent if exponent > largest[i] else largest[i]
    for member in range(n_sources):
        _half_squares(sources, targets, member, first, q)
        for i in range(BLOCK):
            total[i] += exp((log_w[member] - q[i]) - largest[i])
    for i in range(BLOCK):
        total[i] = largest[i] + math.log(total[i])


@compiled
def log_kernel_density(w, X, V, free, H, active, work, out):
    """Log-density at the columns of V of the particles X with normalised weights w.

    Members of zero weight are left out, and may be NaN. A target that is not finite gets -inf.
    """
    sources, targets, log_w, q, largest, total = work
    n_sources = np.int64(0)  # typed, so that `_whiten` is compiled once
    for i in range(w.size):
        if w[i] > 0.0:
            _whiten(H, active, free, X, i, sources, n_sources)
            log_w[n_sources] = math.log(w[i])
            n_sources += 1
        _whiten(H, active, free, V, i, targets, i)
    log_kernel = 0.0
    for a in range(active.size):
        if active[a]:
            log_kernel -= math.log(H[a, a]) + 0.5 * LOG_TWO_PI
    for block in range(-(-out.size // BLOCK)):
        first = block * BLOCK
        _density_block(sources, targets, log_w, n_sources, first, q, largest, total)
        for i in range(min(BLOCK, out.size - first)):
            out[first + i] = total[i] + log_kernel if np.isfinite(total[i]) else -np.inf
