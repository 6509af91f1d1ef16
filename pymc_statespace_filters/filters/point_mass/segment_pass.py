"""A pass over a record on segments, for densities that no uniform grid holds.

A pass hands its segments to ``keep(tape, k, segments)`` after the update of every step. It may be
repeated from step 0 on, with a longer reach or finer segments.
"""

import math

import numpy as np

from ...compiler.native.jit import inline_always, njit_internal
from ..outcomes import NONE, STATE_NOT_FINITE, TOO_FAR, is_missing
from .bisection import Accuracy, Step, known_point, resolved_segments
from .forward_pass import LENGTHENING, LONGEST_REACH, SHORTEST_REACH
from .recursion import TOO_COARSE, TOO_SHORT, initial_moments, is_known, truncation_of
from .segments import POINTS, mixture

# Relative to the tolerance: a segment's share of the error, and a mass that need not be resolved.
_SHARE, _NEGLIGIBLE = 0.1, 1e-5
_MUCH_LARGER = 1e3  # than the floor needed: the pass is repeated


@inline_always
def discard_segments(tape, k, segments):
    """Keep no segments: a likelihood needs none."""


@njit_internal
def first_accuracy(tolerance):
    """(reach, floor) of the first attempt: masses below the floor need not be resolved."""
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
def pass_on_segments(system, steps, observed, t0, tolerance, terms, keep, tape):
    """Write the terms; return (NONE, J), or (reason, observation) of a failure."""
    reach, floor = first_accuracy(tolerance)
    code, j, _, _ = pass_from(
        system, steps, observed, t0, reach, floor, tolerance, terms, keep, tape
    )
    return code, j


@njit_internal
def pass_from(system, steps, observed, t0, reach, floor, tolerance, terms, keep, tape):
    """The same from this accuracy on: (NONE, J, reach, floor), or (reason, observation, ..)."""
    while True:
        code, j, needed = _attempt(
            system, steps, observed, t0, reach, floor, tolerance, terms, keep, tape
        )
        code, reach, floor = next_accuracy(code, reach, floor, needed)
        if code >= NONE:
            return code, j, reach, floor


@njit_internal
def _attempt(system, steps, observed, t0, reach, floor, tolerance, terms, keep, tape):
    """Write the terms of one pass: (NONE, J, floor), or (reason, observation, floor needed)."""
    if steps.size == 0:
        return NONE, np.int64(0), floor
    mean, sd = initial_moments(system)
    if not (np.isfinite(mean) and np.isfinite(sd)):
        return STATE_NOT_FINITE, np.int64(0), floor
    cut = truncation_of(reach)
    one = np.zeros((1, POINTS))
    one[0, 0] = 1.0
    source = mixture(np.full((1, POINTS), mean), np.full((1, POINTS), sd), one, reach, 0.0, 0.0)
    most_surprise = np.inf
    log_left = 0.0  # log of the mass that remains since the last observation
    j, n_cuts = np.int64(0), 0
    for k in range(steps[-1] + 1):
        is_row = steps[j] == k
        observes = is_row and not is_missing(observed, j)
        step = Step(k, t0 + k * system.dt, observed[j], observes, k < steps[-1])
        if k == 0 and is_known(mean, sd):
            code, segments, term = known_point(system, step, mean)
        else:
            n_cuts += 1
            most_surprise = math.log(tolerance) - math.log(n_cuts * cut)
            accuracy = Accuracy(_SHARE * tolerance, floor, most_surprise)
            code, segments, term = resolved_segments(system, step, source, accuracy)
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
        log_left += term
        if is_row:
            terms[j] = log_left if observes else 0.0
            j += 1
        if observes:
            log_left = 0.0
        source = mixture(segments.mean, segments.sd, segments.mass, reach, cut, floor)
    return NONE, steps.size, floor
