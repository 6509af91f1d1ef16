"""One pass of the point-mass filter over a record, and what an evaluation begins again with.

A pass hands its grids to ``keep(tape, k, grid, seen)``: the grid of every step, and at an
observation the grid once more, with what was seen there.
"""

import math

import numpy as np

from pymc_statespace_filters.compiler.native.jit import inline_always, njit_internal
from pymc_statespace_filters.filters.outcomes import NONE, is_missing
from pymc_statespace_filters.filters.point_mass.recursion import (
    REFINEMENT,
    TOO_COARSE,
    TOO_SHORT,
    begin,
    forecast,
    initial_moments,
    no_table,
    see,
)
from pymc_statespace_filters.filters.system_table import step_moments

_LENGTHENING = 1.6
_SHORTEST_REACH, _LONGEST_REACH = 8.5, 35.0  # deviations: densities down to 2e-16, to 1e-265
_PER_STEP = 1e-5  # of the tolerance, what one step's error is planned for


@inline_always
def keep_nothing(tape, k, grid, seen):
    """What a likelihood does with the grids."""


@inline_always
def first_lattice(system, steps, t0, tolerance):
    """Spacing and reach of the first attempt."""
    spacing = np.inf
    if steps.size:
        spacing = _first_spacing(system, t0, steps[-1], tolerance)
    return spacing, _SHORTEST_REACH


@njit_internal
def _first_spacing(system, t0, n_steps, tolerance):
    """The spacing that the first step asks for around the start; see `_lattice.aliasing`."""
    spacing = np.inf
    if n_steps == 0:
        return spacing
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
    return spacing * math.pi * math.sqrt(-2.0 / math.log(_PER_STEP * tolerance))


@inline_always
def next_lattice(code, spacing, reach):
    """After an attempt: (whether to begin again, spacing, reach)."""
    if code == TOO_COARSE:
        return True, spacing * REFINEMENT, reach
    if code == TOO_SHORT and reach * _LENGTHENING < _LONGEST_REACH:
        return True, spacing, reach * _LENGTHENING
    return False, spacing, reach


@inline_always
def attempt(system, steps, observed, t0, spacing, reach, tolerance, terms, keep, tape):
    """One pass over the record: its terms, and (NONE, J) or (why it stopped, where)."""
    k = np.int64(0)
    code, grid, source = begin(system, spacing, reach)
    if code == NONE:
        keep(tape, k, grid, False)
    table = no_table()
    error, n_grids = 0.0, 1
    for j in range(steps.size):
        while k < steps[j] and code == NONE:
            t = t0 + k * system.dt
            code, grid, source, table, lost = forecast(system, k, t, spacing, reach, grid, table)
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
        code, grid, terms[j] = see(
            system, k, t, observed[j], reach, grid, source, n_grids, error, tolerance
        )
        if code != NONE:
            return code, j
        keep(tape, k, grid, True)
        error, n_grids = 0.0, 1
    return code, steps.size
