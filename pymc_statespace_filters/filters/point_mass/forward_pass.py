"""One pass of the point-mass filter over a record on a grid, and what the next attempt does."""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import njit_internal
from ..outcomes import GRID_TOO_LARGE, NO_PROCESS_NOISE, NONE, TOO_FAR, is_missing
from ..plan import step_moments
from .law import AT_START, OF_SEGMENTS, grid_of, keep_grid
from .recursion import (
    REFINEMENT,
    TOO_COARSE,
    TOO_SHORT,
    empty_table,
    initialise,
    predict,
    update,
)

_LENGTHENING = 1.6
# In standard deviations: densities down to 2e-16, and down to 1e-265.
SHORTEST_REACH, LONGEST_REACH = 8.5, 35.0
# Of a run that leaves a state: what is cut off here is missing in all rows to come, which may be a
# surprise. Densities down to 7e-41.
_REACH_OF_STATE = _LENGTHENING * SHORTEST_REACH
# Relative to the tolerance: a mass on a segment that need not be resolved.
NEGLIGIBLE = 1e-5
_NEGLIGIBLE_OF_STATE = 1e-15  # as rows to come may be a surprise
_PER_STEP = 1e-5  # planned error of one step, relative to the tolerance
_COARSER = 1.2  # than planned: the error of a step stays below the tolerance
# A density that needs more is not smooth, and segments mostly hold it at a fraction of the cost.
_MOST_REFINEMENTS = 4

# Where the next attempt represents the density, or that there is none.
ON_GRID, ON_SEGMENTS, END = range(3)


class Settings(NamedTuple):
    """Where the next attempt represents the density, and how finely.

    A grid has a spacing and a reach, was refined so many times, and may be further. Of segments,
    masses below the floor need not be resolved.
    """

    place: int
    spacing: float
    reach: float
    n_refined: int
    is_refinable: bool
    segment_reach: float
    floor: float


@njit_internal
def _first_spacing(system, record, law, tolerance):
    """The spacing that the first step requires.

    The step is taken from the mean of the law and one standard deviation to either side, see
    `grid.aliasing`.
    """
    spacing, steps, (mean, sd) = np.inf, record.steps, (law.mean, law.sd)
    if steps.size == 0 or steps[-1] == law.k:
        return spacing
    X, M = np.empty((1, 3)), np.empty((2, 3))
    for i in range(3):
        X[0, i] = mean + (i - 1) * sd
    step_moments(system, law.k, record.t0 + law.k * system.dt, X, M)
    slope = (M[0, 2] - M[0, 0]) / (2.0 * sd) if sd > 0.0 else 1.0
    for i in range(3):
        width = math.sqrt(M[1, i] / (1.0 + slope * slope))
        if width > 0.0:
            spacing = min(spacing, width)
    return spacing * math.pi * math.sqrt(-2.0 / math.log(_PER_STEP * tolerance))


@njit_internal
def first_attempt(system, record, law, tolerance, leaves_state):
    """The settings of the first attempt: a law on segments is not put on a grid again."""
    reach, floor = SHORTEST_REACH, NEGLIGIBLE * tolerance
    if leaves_state:
        reach, floor = _REACH_OF_STATE, _NEGLIGIBLE_OF_STATE * tolerance
    if law.kind == OF_SEGMENTS:
        return Settings(ON_SEGMENTS, np.inf, reach, 0, False, reach, floor)
    spacing = _first_spacing(system, record, law, tolerance)
    return Settings(ON_GRID, spacing, reach, 0, True, reach, floor)


@njit_internal
def next_attempt(settings, code, needed):
    """The settings after an attempt that ended with this code; ``needed`` is a floor of masses.

    Segments are tried once. If they fail, as where mass explodes, a grid that was only too coarse
    is refined further.
    """
    place, spacing, reach, n_refined, is_refinable, segment_reach, floor = settings
    if place == ON_SEGMENTS:
        place = ON_GRID if is_refinable and code == GRID_TOO_LARGE else END
        if code == TOO_SHORT:
            segment_reach *= _LENGTHENING
            place = ON_SEGMENTS if segment_reach < LONGEST_REACH else END
        elif code == TOO_COARSE:
            place, floor = ON_SEGMENTS if needed < floor else END, needed
    elif code == TOO_SHORT:
        reach *= _LENGTHENING
        place = ON_GRID if reach < LONGEST_REACH else END
    elif code == TOO_COARSE:
        place = ON_SEGMENTS if n_refined == _MOST_REFINEMENTS else ON_GRID
        spacing, n_refined = spacing * REFINEMENT, n_refined + 1
    elif code in (GRID_TOO_LARGE, NO_PROCESS_NOISE) and n_refined <= _MOST_REFINEMENTS:
        place, is_refinable = ON_SEGMENTS, False
    else:
        place = END
    return Settings(place, spacing, reach, n_refined, is_refinable, segment_reach, floor)


@njit_internal
def _begin(law, settings):
    """(code, grid, source) at the step of a law; its own grid is finer if the first step asks."""
    spacing = settings.spacing
    if law.kind == AT_START:
        return initialise(law.mean, law.sd, spacing, settings.reach)
    needed = spacing / REFINEMENT**settings.n_refined
    grid, none = grid_of(law, needed if law.spacing > _COARSER * needed else np.inf), np.empty(0)
    return np.int64(NONE if grid[2].size else GRID_TOO_LARGE), grid, (none, none, none)


@njit_internal
def pass_on_grid(system, record, law, settings, tolerance, terms, tape):
    """Write the terms of one pass; return (NONE, J), or (reason, observation) of a stop."""
    steps, observed, t0 = record.steps, record.observed, record.t0
    spacing, reach = settings.spacing, settings.reach
    k = law.k
    code, grid, source = _begin(law, settings)
    if code == NONE:
        keep_grid(tape, k, grid, False)
    table = empty_table()
    error, n_grids = 0.0, 1
    for j in range(steps.size):
        while k < steps[j] and code == NONE:
            t = t0 + k * system.dt
            code, grid, source, table, lost = predict(system, k, t, spacing, reach, grid, table)
            error += lost
            n_grids += 1
            if code == NONE and error > tolerance:
                code = TOO_COARSE
            k += 1
            if code == NONE:
                keep_grid(tape, k, grid, False)
        if code != NONE:
            return code, j
        if is_missing(observed, j):
            terms[j] = 0.0
            continue
        t = t0 + k * system.dt
        code, grid, terms[j] = update(
            system, k, t, observed[j], reach, grid, source, n_grids, error, tolerance
        )
        if code != NONE:
            return code, j
        keep_grid(tape, k, grid, True)
        error, n_grids = 0.0, 1
    return code, steps.size


@njit_internal
def write_outcome(code, j, terms, health):
    """Write the health of a pass that ended with a code at observation j; later terms are -inf."""
    terms[j:] = -np.inf
    health[0], health[1] = np.inf, code if code >= NONE else TOO_FAR
    health[2] = j if code != NONE else -1
