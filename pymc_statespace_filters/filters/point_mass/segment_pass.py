"""A pass over a record on segments, for densities that no uniform grid holds; and all passes."""

import math

import numpy as np

from ...compiler.native.jit import njit_internal
from ..outcomes import GRID_TOO_LARGE, NONE, STATE_NOT_FINITE, is_missing
from .bisection import (
    Accuracy,
    Step,
    known_point,
    resolved_segments,
    segments_of_mixture,
)
from .forward_pass import (
    END,
    NEGLIGIBLE,
    ON_GRID,
    first_attempt,
    next_attempt,
    pass_on_grid,
)
from .law import OF_SEGMENTS, density_of_law, keep_segments, on_segments, segments_of_law
from .recursion import TOO_COARSE, TOO_SHORT, is_known, truncation_of
from .segments import POINTS, density, mixture

_SHARE = 0.1  # of a segment in the error, relative to the tolerance
_MUCH_LARGER = 1e3  # than the floor needed: the pass is repeated


@njit_internal
def finished(system, record, settings, tolerance, terms, tape, rows):
    """(code, observation, floor needed) of a likelihood, which is done after a pass."""
    return NONE, record.steps.size, settings.floor


@njit_internal
def along_record(system, record, law, is_wide, tolerance, terms, tape, finish, rows):
    """Write the terms by passes until one succeeds: (NONE, J), or (reason, observation).

    Passes begin with ``law``, keep what a `Tape` wants and end with ``finish``, as `finished`. A
    wide one leaves a state, and has a longer reach where memory suffices.
    """
    if system.failure != NONE:
        return np.int64(system.failure), np.int64(0)
    code, j = np.int64(NONE), np.int64(0)
    settings = first_attempt(system, record, law, tolerance, is_wide)
    while settings.place != END:
        tape.laws.clear()
        if settings.place == ON_GRID:
            code, j = pass_on_grid(system, record, law, settings, tolerance, terms, tape)
            needed = settings.floor
        else:
            code, j, needed = pass_on_segments(
                system, record, on_segments(law), settings, tolerance, terms, tape
            )
        if code == NONE:
            code, j, needed = finish(system, record, settings, tolerance, terms, tape, rows)
        settings = next_attempt(settings, code, needed)
        if settings.place == END and code == GRID_TOO_LARGE and is_wide:
            is_wide = False
            settings = first_attempt(system, record, law, tolerance, is_wide)
    return code, j


@njit_internal
def pass_on_segments(system, record, law, settings, tolerance, terms, tape):
    """Write the terms of one pass: (NONE, J, floor), or (reason, observation, floor needed)."""
    steps, observed, mean, sd = record.steps, record.observed, law.mean, law.sd
    reach, floor = settings.segment_reach, settings.floor
    if steps.size == 0:
        return NONE, np.int64(0), floor
    if not (np.isfinite(mean) and np.isfinite(sd)):
        return STATE_NOT_FINITE, np.int64(0), floor
    cut = truncation_of(reach)
    one = np.zeros((1, POINTS))
    one[0, 0] = 1.0
    source = mixture(np.full((1, POINTS), mean), np.full((1, POINTS), sd), one, reach, 0.0, 0.0)
    most_surprise = np.inf
    log_left = 0.0  # log of the mass that remains since the last observation
    j, n_cuts = np.int64(0), 0
    for k in range(law.k, steps[-1] + 1):
        is_row = steps[j] == k
        observes = is_row and not is_missing(observed, j)
        step = Step(k, record.t0 + k * system.dt, observed[j], observes, k < steps[-1])
        goes_on = k == law.k and law.kind == OF_SEGMENTS
        if k == law.k and is_known(mean, sd):
            code, segments, term = known_point(system, step, mean)
        elif goes_on:
            accuracy = Accuracy(_SHARE * tolerance, floor, most_surprise)
            code, segments, term = resolved_segments(
                system, step, segments_of_law, density_of_law, law, accuracy
            )
        else:
            n_cuts += 1
            most_surprise = math.log(tolerance) - math.log(n_cuts * cut)
            accuracy = Accuracy(_SHARE * tolerance, floor, most_surprise)
            code, segments, term = resolved_segments(
                system, step, segments_of_mixture, density, source, accuracy
            )
        if code != NONE:
            return code, j, floor
        if observes and n_cuts > 0:
            surprise = segments.log_likelihood.max() - term
            if segments.mass[0, 0] + segments.mass[-1, -1] > tolerance or surprise > most_surprise:
                return TOO_SHORT, j, floor
            needed = math.exp(math.log(NEGLIGIBLE * tolerance) - max(surprise, 0.0))
            needed = max(needed, cut)
            if floor > _MUCH_LARGER * needed:
                return TOO_COARSE, j, needed
            n_cuts = 0
        keep_segments(tape, k, segments)
        log_left += 0.0 if goes_on else term
        if is_row:
            terms[j] = log_left if observes else 0.0
            j += 1
        if observes:
            log_left = 0.0
        source = mixture(segments.mean, segments.sd, segments.mass, reach, cut, floor)
    return NONE, steps.size, floor
