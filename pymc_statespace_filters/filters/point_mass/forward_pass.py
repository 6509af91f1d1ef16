"""One pass of the point-mass filter over a record, and the grid settings of the next attempt.

A pass hands its grids to ``keep(tape, k, grid, updated)``: the predicted grid of every step, and at
an observation the updated grid too.
"""

import math

import numpy as np

from pymc_statespace_filters.compiler.native.jit import inline_always, njit_internal
from pymc_statespace_filters.filters.outcomes import NONE, is_missing
from pymc_statespace_filters.filters.point_mass.recursion import (
    REFINEMENT,
    TOO_COARSE,
    TOO_SHORT,
    empty_table,
    initial_moments,
    initialise,
    predict,
    update,
)
from pymc_statespace_filters.filters.system_table import step_moments

LENGTHENING = 1.6
# In standard deviations: densities down to 2e-16, and down to 1e-265.
SHORTEST_REACH, LONGEST_REACH = 8.5, 35.0
_PER_STEP = 1e-5  # planned error of one step, relative to the tolerance


@inline_always
def discard(tape, k, grid, updated):
    """Keep no grid: a likelihood needs none."""


@njit_internal
def first_grid(system, steps, t0, tolerance):
    """(spacing, reach) of the first attempt: the spacing that the first step requires.

    The step is taken from the initial mean and one standard deviation to either side, see
    `grid.aliasing`.
    """
    spacing = np.inf
    if steps.size == 0 or steps[-1] == 0:
        return spacing, SHORTEST_REACH
    mean, sd = initial_moments(system)
    X, M = np.empty((1, 3)), np.empty((2, 3))
    for i in range(3):
        X[0, i] = mean + (i - 1) * sd
    step_moments(system, 0, t0, X, M)
    slope = (M[0, 2] - M[0, 0]) / (2.0 * sd) if sd > 0.0 else 1.0
    for i in range(3):
        width = math.sqrt(M[1, i] / (1.0 + slope * slope))
        if width > 0.0:
            spacing = min(spacing, width)
    spacing = spacing * math.pi * math.sqrt(-2.0 / math.log(_PER_STEP * tolerance))
    return spacing, SHORTEST_REACH


@njit_internal
def next_grid(code, spacing, reach):
    """After an attempt that ended with this code: (whether to repeat it, spacing, reach)."""
    if code == TOO_COARSE:
        return True, spacing * REFINEMENT, reach
    if code == TOO_SHORT and reach * LENGTHENING < LONGEST_REACH:
        return True, spacing, reach * LENGTHENING
    return False, spacing, reach


@njit_internal
def attempt(system, steps, observed, t0, spacing, reach, tolerance, terms, keep, tape):
    """Write the terms of one pass; return (NONE, J), or (reason, observation) of a stop."""
    k = np.int64(0)
    code, grid, source = initialise(system, spacing, reach)
    if code == NONE:
        keep(tape, k, grid, False)
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
                keep(tape, k, grid, False)
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
        keep(tape, k, grid, True)
        error, n_grids = 0.0, 1
    return code, steps.size
