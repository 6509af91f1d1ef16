"""The verbs of the point-mass filter: begin, forecast, see.

A *grid* is (low, spacing, masses), see `_lattice`; its *source* is the mixture of Gaussians
(means, deviations, masses) that the masses were taken from, which has a density at any point: where
an observation asks for a finer grid, it is made of the source. A known state is the grid whose
point number 1, of spacing x_0, is x_0. A *table* keeps the kernel of a step that is the same at
every time, for the points from its first on.
"""

import math

import numpy as np

from pymc_statespace_filters.compiler.native.jit import inline_always, njit_internal
from pymc_statespace_filters.filters.outcomes import (
    GRID_TOO_LARGE,
    NO_FINITE_MEMBER,
    NO_PROCESS_NOISE,
    NONE,
    ZERO_WEIGHTS,
)
from pymc_statespace_filters.filters.point_mass.grid import (
    MAX_POINTS,
    aliasing,
    coarseness,
    highest,
    kernel,
    lattice,
    move,
    normalise,
    reached,
    significant,
    spread,
    total,
    weigh,
)
from pymc_statespace_filters.filters.system_table import log_density, step_moments

# Reasons to begin again, beside the failures.
TOO_COARSE, TOO_SHORT = -1, -2

REFINEMENT = 0.7
"""Factor of the spacing where it is too coarse."""

_KNOWN = 1e-15  # a deviation below this share of the mean is lost in the mean's rounding


@njit_internal
def no_table():
    """A table of no points."""
    nothing, none = np.empty(0), np.empty(0, np.int64)
    return np.int64(0), nothing, nothing, nothing, (none, none, nothing)


@inline_always
def has_valid_covariances(system):
    """Whether every covariance of the system is positive semidefinite."""
    for root in system.c[system.n_theta + system.n :]:
        if np.isnan(root):
            return False
    return True


@inline_always
def initial_moments(system):
    """Mean and standard deviation of the state at step 0."""
    return system.c[system.n_theta], system.c[system.n_theta + 1]


@inline_always
def cut_of(reach):
    """The share of the largest mass below which masses are dropped."""
    return math.exp(-0.5 * reach * reach)


@njit_internal
def begin(system, spacing, reach):
    """The grid at step 0, and the mixture (of one) that its masses are taken from."""
    (mean, sd), one = initial_moments(system), np.full(1, 1.0)
    source = np.full(1, mean), np.full(1, sd), one
    if not (np.isfinite(mean) and np.isfinite(sd)):
        return NO_FINITE_MEMBER, (np.int64(0), 1.0, one), source
    if sd <= _KNOWN * abs(mean):
        return NONE, (np.int64(1), mean, one), source  # point 1 of this spacing
    spacing = min(spacing, 0.6 * sd)
    low, n = reached(*source, spacing, reach)
    if n > MAX_POINTS:
        return GRID_TOO_LARGE, (low, spacing, one), source
    return NONE, (low, spacing, spread(low, n, spacing, *source, reach)), source


@njit_internal
def forecast(system, k, t, spacing, reach, grid, table):
    """One step: (code, grid, the mixture that it was taken from, table, share of error)."""
    low, _, mass = grid
    tabled, mean, sd, shares, table = step_from(system, k, t, spacing, reach, grid, table)
    lost = total(mass, shares)
    if lost == np.inf:
        return NO_PROCESS_NOISE, grid, (mean, sd, mass), table, lost
    target, n = reached(mean, sd, mass, spacing, reach)
    if n > MAX_POINTS:
        target, n = _drop_escaping(system, k, t, mean, sd, mass, spacing, reach)
    source = mean, sd, mass
    if n == 0 or n > MAX_POINTS:
        code = NO_FINITE_MEMBER if n == 0 else GRID_TOO_LARGE
        return code, grid, source, table, lost
    if tabled:
        starts, ends, masses = rows_from(low, table)
        out = move(starts, ends, masses, mass, target, n)
    else:
        out = spread(target, n, spacing, *source, reach)
    i, j = significant(out, cut_of(reach))
    return NONE, (target + i, spacing, out[i:j]), source, table, lost


@inline_always
def step_from(system, k, t, spacing, reach, grid, table):
    """What one step does to every point: (is it in the table?, mean, sd, shares, table)."""
    low, here, mass = grid
    tabled = system.is_time_invariant and here == spacing and mass.size > 1
    first, mean, sd, shares, rows = table
    if not tabled or low < first or low + mass.size > first + mean.size:
        first, n = low, mass.size
        if tabled:  # room for the density to move
            first, n = low - n // 4, n + n // 2
        mean, sd, shares = _moments(system, k, t, lattice(first, n, here), here, spacing)
        if tabled:
            rows = kernel(spacing, mean, sd, reach)
            table = first, mean, sd, shares, rows
    here_on = slice(low - first, low - first + mass.size)
    return tabled, mean[here_on], sd[here_on], shares[here_on], table


@inline_always
def rows_from(low, table):
    """The rows of a table's kernel from point ``low`` on."""
    first, _, _, _, (starts, ends, masses) = table
    return starts[low - first :], ends[low - first :], masses


@inline_always
def _moments(system, k, t, X, source_spacing, spacing):
    """Mean and deviation of the next state from every point, and what a step may misplace."""
    M = np.empty((2, X.shape[1]))
    step_moments(system, k, t, X, M)
    mean, sd = M[0], M[1]
    for i in range(sd.size):
        sd[i] = math.sqrt(sd[i])
    return mean, sd, aliasing(mean, sd, source_spacing, spacing)


@njit_internal
def _drop_escaping(system, k, t, mean, sd, mass, spacing, reach):
    """Take the mass off exploding points, the fastest first, until a lattice holds the rest.

    Those are points whose path without noise is infinite some steps later.
    """
    X, M = np.empty((1, mean.size)), np.empty((2, mean.size))
    for i in range(mean.size):
        M[0, i] = mean[i]
    low, n = np.int64(0), np.int64(MAX_POINTS + 1)
    for _ in range(20):
        for i in range(mean.size):
            X[0, i] = M[0, i]
        step_moments(system, k, t, X, M)
        for i in range(mass.size):
            if not np.isfinite(M[0, i]):
                mass[i] = 0.0
        low, n = reached(mean, sd, mass, spacing, reach)
        if n <= MAX_POINTS:
            break
    return low, n


@njit_internal
def see(system, k, t, d, reach, grid, source, n_grids, error, tolerance):
    """Update: (code, grid, log p(d_j | d_1 .. d_{j-1})), on a finer grid where needed.

    ``error`` is the mass that the steps since the last update may have misplaced, and of each of
    the ``n_grids`` since then the ends were cut off: they may lie where the observation looks.
    """
    low, spacing, mass = grid
    cut = cut_of(reach)
    log_cut, log_error, log_tolerance = (
        math.log(n_grids * cut),
        math.log(error),
        math.log(tolerance),
    )
    while True:
        log_likelihood = np.empty(mass.size)
        log_density(system, k, t, d, lattice(low, mass.size, spacing), log_likelihood)
        term, posterior = weigh(mass, log_likelihood)
        if term == -np.inf:
            return ZERO_WEIGHTS, grid, term
        first, last = significant(posterior, cut)
        normalise(posterior)
        known = mass.size == 1
        if not known and posterior[0] + posterior[-1] > tolerance:
            return TOO_SHORT, grid, term
        if known or coarseness(posterior) <= tolerance:
            surprise = highest(log_likelihood) - term
            if not known and log_cut + surprise > log_tolerance:
                return TOO_SHORT, grid, term
            if log_error + surprise > log_tolerance:
                return TOO_COARSE, grid, term
            return NONE, (low + first, spacing, posterior[first:last]), term
        start, end = (low + first - 2) * spacing, (low + last + 1) * spacing
        spacing *= REFINEMENT
        low = np.int64(math.floor(start / spacing))
        n = np.int64(math.ceil(end / spacing)) - low + 1
        if n > MAX_POINTS:
            return GRID_TOO_LARGE, grid, term
        mass = spread(low, n, spacing, *source, reach)
