"""States on segments: moments and draws of the state at chosen steps, see the module `states`."""

import math

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.numerics.philox import STATES, uniform_at
from ...compiler.numerics.restricted_domain import exp
from ..outcomes import NONE
from .bisection import empty_segments
from .forward_pass import LONGEST_REACH
from .law import leave_segments, on_segments
from .moments import PREDICTED, SMOOTHED
from .recursion import TOO_COARSE, TOO_SHORT
from .segment_pass import first_accuracy, next_accuracy, pass_from
from .segments import POINTS, draw, mean_over_gaussian, moments

_FINER = 1e-10  # the next floor, where smoothed mass lies on segments that were not resolved


@njit_internal
def states_on_segments(system, record, law, is_wide, tolerance, moment, rows, stored, terms, after):
    """Write rows and terms; return (NONE, J), or (reason, observation) of a failure."""
    kept = [empty_segments(1)]  # lets numba infer the type of the empty list
    tape, again, steps, law = (kept, stored, law.k), True, record.steps, on_segments(law)
    reach, floor = first_accuracy(tolerance, is_wide)
    while again:
        code, j, reach, floor = pass_from(
            system, record, law, reach, floor, tolerance, terms, _keep, tape
        )
        if moment == SMOOTHED and code == NONE and rows.at.size:
            code, j = _smooth(steps, floor, tolerance, rows, kept, stored)
            code, reach, floor = next_accuracy(code, reach, floor, _FINER * floor)
        again = code < NONE
    if moment != SMOOTHED:
        _write_rows(rows, kept, moment)
        if after.size and code == NONE and stored.size:
            leave_segments(after, stored[-1], kept[-1])
    return code, j


@njit_internal
def _keep(tape, k, segments):
    """Append the segments of a stored step to the tape, which a repeated pass starts anew."""
    kept, stored, first = tape
    if k == first:
        kept.clear()
    n = len(kept)
    if n < stored.size and stored[n] == k:
        kept.append(segments)


@njit_internal
def _write_rows(rows, kept, moment):
    """Write moments and a draw; rows that were not reached are NaN."""
    for i in range(rows.at.size):
        rows.mean[i], rows.sd[i], rows.drawn[i] = np.nan, np.nan, np.nan
        if i < len(kept):
            here = kept[i]
            u = uniform_at(rows.draw_seed, STATES, rows.at[i], 0)
            mass = here.predicted if moment == PREDICTED else here.mass
            rows.mean[i], rows.sd[i] = moments(here.low, here.high, mass)
            rows.drawn[i] = draw(here.low, here.high, mass, u)


@njit_internal
def _smooth(steps, floor, tolerance, rows, kept, stored):
    """Write the smoothed rows in a backward pass; return (NONE, J), or (reason, observation)."""
    later = kept[-1]
    ratio, factor, drawn = np.ones(later.mass.shape), np.ones(later.mass.shape), 0.0
    i, j = rows.at.size - 1, steps.size - 1
    for row in range(stored.size - 1, -1, -1):
        k, here = stored[row], kept[row]
        weights = here.mass
        if k < stored[-1]:
            ratio = _mean_after_step(here, later, factor)
            weights = _backward_weights(here, drawn)
        smoothed = here.mass * ratio
        whole = smoothed.sum()
        code = _verdict(here, smoothed, whole, floor, tolerance)
        if code != NONE:
            return code, min(j + 1, steps.size - 1)
        drawn = draw(here.low, here.high, weights, uniform_at(rows.draw_seed, STATES, k, 0))
        if rows.at[i] == k:
            rows.mean[i], rows.sd[i] = moments(here.low, here.high, smoothed)
            rows.drawn[i] = drawn
            i -= 1
        if j >= 0 and steps[j] == k:
            j -= 1
        factor, later = _with_observation(here, ratio, whole), here
    return NONE, steps.size


@njit_internal
def _verdict(here, smoothed, whole, floor, tolerance):
    """Whether the smoothed density lies where the pass had points, and resolved them."""
    if not 0.0 < whole < np.inf:
        return TOO_SHORT
    n = here.low.size
    if here.low[0] == here.high[n - 1]:
        return NONE
    if smoothed[0, 0] + smoothed[-1, -1] > tolerance * whole:
        return TOO_SHORT
    unresolved = 0.0
    for p in range(n):
        if here.mass[p].sum() <= floor:
            unresolved += smoothed[p].sum()
    return TOO_COARSE if unresolved > tolerance * whole else NONE


@njit_internal
def _mean_after_step(here, later, factor):
    """The mean of ``factor``, given on the later segments, after a step from every point."""
    out = np.zeros(here.mass.shape)
    for p in range(here.low.size):
        for i in range(POINTS):
            mean, sd = here.mean[p, i], here.sd[p, i]
            if here.mass[p, i] > 0.0 and np.isfinite(mean) and 0.0 < sd < np.inf:
                out[p, i] = mean_over_gaussian(
                    later.low, later.high, factor, mean, sd, LONGEST_REACH
                )
    return out


@njit_internal
def _backward_weights(here, x):
    """Masses times the densities of the state x one step later."""
    out = np.zeros(here.mass.shape)
    for p in range(here.low.size):
        for i in range(POINTS):
            precision = 1.0 / here.sd[p, i] if here.sd[p, i] > 0.0 else 0.0
            z = (x - here.mean[p, i]) * precision
            weight = here.mass[p, i] * precision * exp(-0.5 * z * z)
            out[p, i] = weight if weight > 0.0 else 0.0  # a diverged point gives NaN
    return out


@njit_internal
def _with_observation(here, ratio, whole):
    """The ratio times the likelihood, up to a factor; zero at points without mass."""
    out, highest = np.zeros(ratio.shape), -np.inf
    for p in range(here.low.size):
        for i in range(POINTS):
            if here.mass[p, i] > 0.0:
                highest = max(highest, here.log_likelihood[p, i])
    for p in range(here.low.size):
        for i in range(POINTS):
            if here.mass[p, i] > 0.0:
                likelihood = math.exp(here.log_likelihood[p, i] - highest)
                out[p, i] = ratio[p, i] / whole * likelihood
    return out
