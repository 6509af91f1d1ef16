"""Moments and draws of weighted parts, a column for each, see `state_law`.

A column holds exact values of some states, then mean and lower triangle of the covariance of the
others. ``order`` tells where each state of the system is among the exact ones and these.
"""

import math

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.numerics.philox import STATES, uniform_at
from ...compiler.numerics.small_cholesky import covariance_root


@njit_internal
def choose(w, u):
    """The part in whose share of the whole weight a number of (0, 1) falls."""
    chosen, cumulative = 0, 0.0
    for i in range(w.size):
        if w[i] > 0.0:
            chosen = i
            cumulative += w[i]
            if u < cumulative:
                break
    return chosen


@njit_internal
def mixture_moments(w, X, n_exact, order, spread, mean, cov):
    """Mean and covariance of the whole state; that between the parts is divided by ``spread``."""
    n = order.size
    for a in range(n):
        mean[a] = 0.0
        for i in range(w.size):
            if w[i] > 0.0:
                mean[a] += w[i] * X[order[a], i]
    for a in range(n):
        for b in range(a + 1):
            within, between = 0.0, 0.0
            row = _row_of_cov(n, n_exact, order[a], order[b])
            for i in range(w.size):
                if w[i] > 0.0:
                    between += w[i] * (X[order[a], i] - mean[a]) * (X[order[b], i] - mean[b])
                    within += w[i] * X[row, i] if row >= 0 else 0.0
            cov[a, b] = cov[b, a] = within + (between / spread if spread > 0.0 else 0.0)


@njit_internal
def _row_of_cov(n, n_exact, a, b):
    """The row of the covariance of two numbers of a column; -1 if one is known given the regime."""
    i, j = max(a, b) - n_exact, min(a, b) - n_exact
    return n + i * (i + 1) // 2 + j if j >= 0 else -1


@njit_internal
def read_moments(X, part, n):
    """Mean (n,) and covariance of a part without exact states."""
    mean, cov = np.empty(n), np.empty((n, n))
    for a in range(n):
        mean[a] = X[a, part]
        for b in range(a + 1):
            cov[a, b] = cov[b, a] = X[_row_of_cov(n, 0, a, b), part]
    return mean, cov


@njit_internal
def write_moments(mean, cov, X, part):
    """Make these the mean and covariance of a part without exact states."""
    n = mean.size
    for a in range(n):
        X[a, part] = mean[a]
        for b in range(a + 1):
            X[_row_of_cov(n, 0, a, b), part] = cov[a, b]


@njit_internal
def draw_of_mixture(w, X, n_exact, order, seed, place, out):
    """A draw of the whole state, that of ``place``."""
    n, part = order.size, choose(w, uniform_at(seed, STATES, place, 0))
    n_normal = n - n_exact
    root, drawn = np.empty((n_normal, n_normal)), np.empty(n)
    for i in range(n_normal):
        for j in range(i + 1):
            row = _row_of_cov(n, n_exact, n_exact + i, n_exact + j)
            root[i, j] = root[j, i] = X[row, part]
    covariance_root(root)
    for a in range(n):
        drawn[a] = X[a, part]
    for j in range(n_normal):
        z = normal_at(seed, place, 1 + 2 * j)
        for i in range(j, n_normal):
            drawn[n_exact + i] += root[i, j] * z
    for a in range(n):
        out[a] = drawn[order[a]]


@njit_internal
def normal_at(seed, place, first):
    """Box and Muller's normal of the two uniform numbers from ``first`` on."""
    u, v = uniform_at(seed, STATES, place, first), uniform_at(seed, STATES, place, first + 1)
    return math.sqrt(-2.0 * math.log(u)) * math.cos(2.0 * math.pi * v)
