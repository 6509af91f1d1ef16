"""The backward pass on segments, see the module `states`."""

import math

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.numerics.philox import STATES, uniform_at
from ...compiler.numerics.restricted_domain import exp
from ..outcomes import NONE
from .forward_pass import LONGEST_REACH
from .recursion import TOO_COARSE, TOO_SHORT
from .segments import POINTS, draw, mean_over_gaussian, moments

_FINER = 1e-10  # the next floor, where smoothed mass lies on segments that were not resolved


@njit_internal
def smooth_segments(steps, floor, tolerance, rows, tape):
    """Write the smoothed rows in a backward pass: (code, observation, floor needed)."""
    at, later = tape.at, tape.laws[-1].parts
    ratio, factor, drawn = np.ones(later.mass.shape), np.ones(later.mass.shape), 0.0
    i, j = rows.at.size - 1, steps.size - 1
    for row in range(at.size - 1, -1, -1):
        k, here = at[row], tape.laws[row].parts
        weights = here.mass
        if k < at[-1]:
            ratio = _mean_after_step(here, later, factor)
            weights = _backward_weights(here, drawn)
        smoothed = here.mass * ratio
        whole = smoothed.sum()
        code = _verdict(here, smoothed, whole, floor, tolerance)
        if code != NONE:
            return code, min(j + 1, steps.size - 1), _FINER * floor
        drawn = draw(here.low, here.high, weights, uniform_at(rows.draw_seed, STATES, k, 0))
        if rows.at[i] == k:
            rows.mean[i], rows.sd[i] = moments(here.low, here.high, smoothed)
            rows.drawn[i] = drawn
            i -= 1
        if j >= 0 and steps[j] == k:
            j -= 1
        factor, later = _with_observation(here, ratio, whole), here
    return NONE, steps.size, floor


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
