"""Gaussian kernel density of weighted particles, in logs (thesis, Eqs. 4.36-4.39).

The density at a target v is sum_l w_l |H|^-1 K(H^-1 (x_l - v)), where H is the lower Cholesky
factor of the weighted covariance times N_eff^{-1/(n+4)}. Members and targets are whitened by H
first, so that the sums see plain distances. In one and two directions they go over a lattice
(`_lattice_sum`), O(N), for targets far outside the cloud too (`_tilted_sum`); in more directions,
for few members and for single targets in the tails they are exact (`_kernel_sum`), O(N) a target.

A direction in which the members do not spread at all (a state known exactly, or a copy of another)
is left out: all members and all targets lie in the same subspace, and the density is the one on it,
n its dimension.
"""

import math

import numpy as np

from pymc_statespace_filters.filters._compile import compiled, pasted
from pymc_statespace_filters.filters._ensemble import count_true, covariance, mean
from pymc_statespace_filters.filters._gaussian import LOG_TWO_PI, semidefinite_cholesky
from pymc_statespace_filters.filters._kernel_sum import (
    compact,
    kernel_sum_workspace,
    log_kernel_sum,
)
from pymc_statespace_filters.filters._lattice_sum import lattice_workspace
from pymc_statespace_filters.filters._tilted_sum import log_lattice_sums, tilted_workspace

_SQRT_HALF = math.sqrt(0.5)
_KNOWN = 1e-13  # a spread below this share of the mean is rounding noise of a value known exactly
_LINE_FROM, _PLANE_FROM = 64, 256  # members from which a lattice is at least twice as fast


@pasted
def _by_lattice(n_active, n_members):
    least = _LINE_FROM if n_active == 1 else _PLANE_FROM
    return 1 <= n_active <= 2 and n_members >= least


def density_method(n_active, n_members):
    """How the densities of n_members particles that spread in n_active directions are summed."""
    return "lattice" if _by_lattice.py_func(n_active, n_members) else "exact"


@compiled
def density_workspace(n, width):
    """Scratch of ``log_kernel_density`` for n directions and a padded number of members."""
    whitened = np.empty((n, width)), np.empty((n, width))
    missed = np.empty(width, np.int64)
    exact, lattice = kernel_sum_workspace(width), lattice_workspace(width)
    return whitened, missed, exact, lattice, tilted_workspace(n, width)


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


@compiled
def _whiten(H, active, free, X, origin, out):
    """Leave H^-1 (X - origin) / sqrt(2) of the active directions in the first rows of ``out``.

    Returns how many rows. The origin is a particle: far from zero x / h would be rounded to more
    than the distances between particles bear.
    """
    row = 0
    for a in range(active.size):
        if not active[a]:
            continue
        x, y, x_0 = X[free[a]], out[row], origin[a]
        scale, before = 1.0 / H[a, a], 0
        for i in range(x.size):
            y[i] = (_SQRT_HALF * scale) * (x[i] - x_0)
        for b in range(a):
            if active[b]:
                share, z = scale * H[a, b], out[before]
                for i in range(x.size):
                    y[i] -= share * z[i]
                before += 1
        row += 1
    return row


@compiled
def log_kernel_density(w, X, V, free, H, active, work, out):
    """Log-density at the columns of V of the particles X with normalised weights w.

    Members of zero weight are left out, and may be NaN. A target that is not finite gets -inf.
    """
    (sources, targets), missed, sum_work, lattice_work, tilted_work = work
    first = 0
    while first < w.size - 1 and not w[first] > 0.0:
        first += 1
    origin = np.empty(free.size)
    for a in range(free.size):
        origin[a] = X[free[a], first]
    n_active = _whiten(H, active, free, X, origin, sources)
    _whiten(H, active, free, V, origin, targets)
    if _by_lattice(n_active, out.size):
        works = sum_work, lattice_work, tilted_work
        n_missed, members = log_lattice_sums(w, sources, targets, n_active, works, missed, out)
    else:
        n_missed, members = out.size, (np.int64(0), np.int64(0))
        for i in range(n_missed):
            missed[i] = i
    if n_missed > 0:
        if members[0] == 0:
            members = compact(w, sources, n_active, sum_work)
        for k in range(n_missed):
            i = missed[k]
            out[i] = log_kernel_sum(sources, n_active, members[1], targets, i, sum_work)
    log_kernel = 0.0
    for a in range(active.size):
        if active[a]:
            log_kernel -= math.log(H[a, a]) + 0.5 * LOG_TWO_PI
    for i in range(out.size):
        out[i] += log_kernel
