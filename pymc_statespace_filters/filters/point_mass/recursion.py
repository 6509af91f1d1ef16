"""The steps of the point-mass filter: initialise, predict, update.

A *grid* is (low, spacing, masses), see the module `grid`. Its *source* is the mixture of Gaussians
(means, standard deviations, masses) that was evaluated on it; the source has a density at any
point, so a finer grid, where an observation requires one, is evaluated from it. A state known
exactly, x_0, is the grid of the single point 1 with spacing x_0. A `Table` stores the
transition kernel of a step that is the same at every time.
"""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import njit_internal
from ..observation_failures import observation_failure
from ..outcomes import GRID_TOO_LARGE, NO_PROCESS_NOISE, NONE, STATE_NOT_FINITE
from ..plan import log_density, step_moments
from .grid import (
    MAX_POINTS,
    aliasing,
    coarseness,
    extent_of,
    grid_points,
    highest,
    normalise,
    scatter,
    significant,
    total,
    weigh,
)
from .tiles import LANES, Tiles, block_of, multiply, no_tiles, tiles_to_sources, tiles_to_targets

# Reasons to repeat the pass on another grid; all other codes are those of `outcomes`.
TOO_COARSE, TOO_SHORT = -1, -2

REFINEMENT = 0.7
"""Factor by which a spacing that is too coarse is reduced."""

_KNOWN = 1e-15  # a smaller standard deviation, relative to the mean, is lost in rounding


# A table grows to what it held before and holds now, up to this multiple of what is needed now.
_GROWTH = 4


class Table(NamedTuple):
    """Mean, sd and relative errors of a step from the points ``first`` on, and its kernel."""

    first: np.int64
    mean: np.ndarray
    sd: np.ndarray
    errors: np.ndarray
    tiles: Tiles


@njit_internal
def empty_table():
    """A table without points."""
    values, zero = np.empty(0), np.int64(0)
    return Table(zero, values, values, values, no_tiles(zero, zero))


@njit_internal
def _range_with(first, end, old_first, old_end):
    """A range of blocks with a margin, and with the one before unless that is too large."""
    margin = (end - first) // 4 + 1
    low, high = first - margin, end + margin
    if old_first < old_end:
        both_low, both_high = min(low, old_first), max(high, old_end)
        if both_high - both_low <= _GROWTH * (high - low):
            low, high = both_low, both_high
    return low, high


@njit_internal
def initial_moments(system):
    """Mean and standard deviation of the state at step 0."""
    return system.c[system.n_theta], system.c[system.n_theta + 1]


@njit_internal
def is_known(mean, sd):
    """Whether a state of these moments is known exactly."""
    return sd <= _KNOWN * abs(mean)


@njit_internal
def truncation_of(reach):
    """Masses below this fraction of the largest are dropped."""
    return math.exp(-0.5 * reach * reach)


@njit_internal
def initialise(mean, sd, spacing, reach):
    """(code, grid, source) at step 0; the source is one Gaussian."""
    one = np.full(1, 1.0)
    source = np.full(1, mean), np.full(1, sd), one
    if not (np.isfinite(mean) and np.isfinite(sd)):
        return STATE_NOT_FINITE, (np.int64(0), 1.0, one), source
    if is_known(mean, sd):
        return NONE, (np.int64(1), mean, one), source
    spacing = min(spacing, 0.6 * sd)
    low, n = extent_of(*source, spacing, reach)
    if n > MAX_POINTS:
        return GRID_TOO_LARGE, (low, spacing, one), source
    return NONE, (low, spacing, scatter(low, n, spacing, *source, reach)), source


@njit_internal
def predict(system, k, t, spacing, reach, grid, table):
    """One step: (code, grid, source, table, mass that the step may misplace)."""
    low, _, mass = grid
    tabled, mean, sd, errors, table = transition_at(system, k, t, spacing, reach, grid, table)
    lost = total(mass, errors)
    if lost == np.inf:
        return NO_PROCESS_NOISE, grid, (mean, sd, mass), table, lost
    target, n = extent_of(mean, sd, mass, spacing, reach)
    if n > MAX_POINTS:
        target, n = _drop_diverging(system, k, t, mean, sd, mass, spacing, reach)
    source = mean, sd, mass
    if n == 0 or n > MAX_POINTS:
        code = STATE_NOT_FINITE if n == 0 else GRID_TOO_LARGE
        return code, grid, source, table, lost
    if tabled:
        first, end = block_of(target), block_of(target + n - 1) + 1
        table = with_targets(table, spacing, reach, first, end)
        out = multiply(table.tiles, low, mass, first, end - first)
        target = LANES * first
    else:
        out = scatter(target, n, spacing, *source, reach)
    i, j = significant(out, truncation_of(reach))
    return NONE, (target + i, spacing, out[i:j]), source, table, lost


@njit_internal
def transition_at(system, k, t, spacing, reach, grid, table):
    """The transition from every point: (whether it is tabled, mean, sd, errors, table)."""
    low, grid_spacing, mass = grid
    tabled = system.is_time_invariant and grid_spacing == spacing and mass.size > 1
    if not tabled:
        X = grid_points(low, mass.size, grid_spacing)
        return tabled, *_moments(system, k, t, X, grid_spacing, spacing), table
    end = low + mass.size
    if low < table.first or end > table.first + table.mean.size:
        old = block_of(table.first), block_of(table.first + table.mean.size)
        first, last = _range_with(block_of(low), block_of(end - 1) + 1, *old)
        X = grid_points(LANES * first, LANES * (last - first), spacing)
        mean, sd, errors = _moments(system, k, t, X, spacing, spacing)
        tiles = no_tiles(table.tiles.low, table.tiles.high)
        table = Table(LANES * first, mean, sd, errors, tiles)
    points = slice(low - table.first, end - table.first)
    return tabled, table.mean[points], table.sd[points], table.errors[points], table


@njit_internal
def _is_within(first, end, tiles):
    """Whether tiles reach the targets in blocks [first, end)."""
    return tiles.block.size > 0 and tiles.low <= first and end <= tiles.high


# Two functions, because numba cannot link what makes both kinds of tiles into one.
@njit_internal
def with_targets(table, spacing, reach, first, end):
    """The table with tiles for a prediction of blocks [first, end)."""
    start, mean, sd, errors, tiles = table
    if _is_within(first, end, tiles):
        return table
    low, high = _range_with(first, end, tiles.low, tiles.high)
    return Table(
        start, mean, sd, errors, tiles_to_targets(start, spacing, mean, sd, reach, low, high)
    )


@njit_internal
def with_sources(table, spacing, reach, first, end):
    """The table with tiles for the adjoint of a prediction of blocks [first, end)."""
    start, mean, sd, errors, tiles = table
    if _is_within(first, end, tiles):
        return table
    low, high = _range_with(first, end, tiles.low, tiles.high)
    return Table(
        start, mean, sd, errors, tiles_to_sources(start, spacing, mean, sd, reach, low, high)
    )


@njit_internal
def _moments(system, k, t, X, source_spacing, spacing):
    """Mean and sd of the next state from every point, and the relative errors of a step."""
    M = np.empty((2, X.shape[1]))
    step_moments(system, k, t, X, M)
    mean, sd = M[0], M[1]
    for i in range(sd.size):
        sd[i] = math.sqrt(sd[i])
    return mean, sd, aliasing(mean, sd, source_spacing, spacing)


@njit_internal
def _drop_diverging(system, k, t, mean, sd, mass, spacing, reach):
    """Remove the mass of diverging points, the fastest first, until a grid holds the rest.

    A point diverges if its path without noise becomes infinite within some steps.
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
        low, n = extent_of(mean, sd, mass, spacing, reach)
        if n <= MAX_POINTS:
            break
    return low, n


@njit_internal
def update(system, k, t, d, reach, grid, source, n_grids, error, tolerance):
    """Bayes' rule: (code, grid, log p(d_j | d_1 .. d_{j-1})), on a finer grid where needed.

    ``error`` is the mass that the steps since the last update may have misplaced, and each of the
    ``n_grids`` grids since then was truncated: the lost mass may lie where the observation puts
    the state, so both are compared with the tolerance after weighting.
    """
    low, spacing, mass = grid
    cut = truncation_of(reach)
    log_cut, log_error = math.log(n_grids * cut), math.log(error)
    log_tolerance = math.log(tolerance)
    while True:
        log_likelihood = np.empty(mass.size)
        log_density(system, k, t, d, grid_points(low, mass.size, spacing), log_likelihood)
        term, posterior = weigh(mass, log_likelihood)
        if term == -np.inf:
            X = grid_points(low, mass.size, spacing)
            return observation_failure(system, k, t, d, X), grid, term
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
        mass = scatter(low, n, spacing, *source, reach)
