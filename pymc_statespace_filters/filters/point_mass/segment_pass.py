"""A pass over a record on segments, for densities that no uniform grid holds.

A pass hands its segments to ``keep(tape, k, segments)`` after the update of every step. It may be
repeated from its beginning on, with a longer reach or finer segments.
"""

import math

import numpy as np

from ...compiler.native.jit import inline_always, njit_internal
from ..outcomes import NONE, STATE_NOT_FINITE, TOO_FAR, is_missing
from .bisection import (
    Accuracy,
    Step,
    known_point,
    resolved_segments,
    segments_of_mixture,
)
from .forward_pass import (
    END,
    LENGTHENING,
    LONGEST_REACH,
    ON_SEGMENTS,
    REACH_OF_STATE,
    SHORTEST_REACH,
    attempt,
    first_attempt,
    next_attempt,
)
from .law import OF_SEGMENTS, density_of_law, law_before, on_segments, segments_of_law
from .recursion import TOO_COARSE, TOO_SHORT, is_known, truncation_of
from .segments import POINTS, density, mixture

# Relative to the tolerance: a segment's share of the error, and a mass that need not be resolved.
_SHARE, _NEGLIGIBLE = 0.1, 1e-5
_NEGLIGIBLE_OF_STATE = 1e-15  # as rows to come may be a surprise
_MUCH_LARGER = 1e3  # than the floor needed: the pass is repeated


@inline_always
def discard_segments(tape, k, segments):
    """Keep no segments: a likelihood needs none."""


@njit_internal
def first_accuracy(tolerance, leaves_state):
    """(reach, floor) of the first attempt: masses below the floor need not be resolved."""
    if leaves_state:
        return REACH_OF_STATE, _NEGLIGIBLE_OF_STATE * tolerance
    return SHORTEST_REACH, _NEGLIGIBLE * tolerance


@njit_internal
def next_accuracy(code, reach, floor, needed):
    """After an attempt that ended with this code: (it, or what it means at last, reach, floor)."""
    if code == TOO_SHORT:
        reach *= LENGTHENING
        return code if reach < LONGEST_REACH else TOO_FAR, reach, floor
    if code == TOO_COARSE:
        return code if needed < floor else TOO_FAR, reach, needed
    return code, reach, floor


@njit_internal
def along_record(system, record, state, tolerance, terms, keep, keep_segments, tape):
    """Write the terms by passes until one succeeds: (NONE, J), or (reason, observation).

    ``state`` is what the filter goes on from, empty where it starts.
    """
    if system.failure != NONE:
        return np.int64(system.failure), np.int64(0)
    law = law_before(system, state)
    place, settings = first_attempt(system, record, law, tolerance, False)
    while place != END:
        if place == ON_SEGMENTS:
            code, j = pass_on_segments(system, record, law, tolerance, terms, keep_segments, tape)
        else:
            code, j = attempt(system, record, law, settings, tolerance, terms, keep, tape)
        place, settings = next_attempt(place, code, settings)
    return code, j


@njit_internal
def pass_on_segments(system, record, law, tolerance, terms, keep, tape):
    """Write the terms; return (NONE, J), or (reason, observation) of a failure."""
    reach, floor = first_accuracy(tolerance, False)
    code, j, _, _ = pass_from(
        system, record, on_segments(law), reach, floor, tolerance, terms, keep, tape
    )
    return code, j


@njit_internal
def pass_from(system, record, law, reach, floor, tolerance, terms, keep, tape):
    """The same from this accuracy on: (NONE, J, reach, floor), or (reason, observation, ..)."""
    while True:
        code, j, needed = _attempt(system, record, law, reach, floor, tolerance, terms, keep, tape)
        code, reach, floor = next_accuracy(code, reach, floor, needed)
        if code >= NONE:
            return code, j, reach, floor


@njit_internal
def _attempt(system, record, law, reach, floor, tolerance, terms, keep, tape):
    """Write the terms of one pass: (NONE, J, floor), or (reason, observation, floor needed)."""
    steps, observed, mean, sd = record.steps, record.observed, law.mean, law.sd
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
            needed = math.exp(math.log(_NEGLIGIBLE * tolerance) - max(surprise, 0.0))
            needed = max(needed, cut)
            if floor > _MUCH_LARGER * needed:
                return TOO_COARSE, j, needed
            n_cuts = 0
        keep(tape, k, segments)
        log_left += 0.0 if goes_on else term
        if is_row:
            terms[j] = log_left if observes else 0.0
            j += 1
        if observes:
            log_left = 0.0
        source = mixture(segments.mean, segments.sd, segments.mass, reach, cut, floor)
    return NONE, steps.size, floor
