"""Densities of one variable on segments: intervals with sixteen Gauss-Lobatto points each.

A uniform grid cannot hold a density with an edge, or one that is narrow in one place and spread
over a thousand widths elsewhere. A segment is bisected where the density, the sensor or the
transition is no polynomial on it, so that points gather at edges and kinks. Both ends are among
the points: an edge between two segments is seen.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import eval_legendre, roots_jacobi

from ...compiler.native.jit import njit_internal
from ...compiler.numerics.restricted_domain import exp

POINTS = 16  # of a segment
MAX_SEGMENTS = 512
"""A density that needs more is a failure, see `filters.outcomes`."""


def _lobatto(n):
    """Nodes, both ends among them, and weights of the quadrature on [-1, 1]."""
    nodes = np.concatenate([[-1.0], roots_jacobi(n - 2, 1.0, 1.0)[0], [1.0]])
    return nodes, 2.0 / (n * (n - 1) * eval_legendre(n - 1, nodes) ** 2)


NODES, WEIGHTS = _lobatto(POINTS)
# Coefficients of the Legendre series of a function on a segment, from its values at the points.
_SERIES = np.linalg.inv(np.polynomial.legendre.legvander(NODES, POINTS - 1))
_TAIL = 3  # coefficients that must be small

_ONE_OVER_ROOT_TWO_PI = 1.0 / math.sqrt(2.0 * math.pi)
_HALVINGS = 50  # of the bisection for a draw within a segment


class Mixture(NamedTuple):
    """Gaussians, in rows of as many as a segment has points.

    Row r reaches from ``low[r]`` to ``high[r]``. ``narrowest`` is the smallest standard deviation
    in it, or infinite where its mass is too small to be resolved.
    """

    mean: np.ndarray
    sd: np.ndarray
    mass: np.ndarray
    low: np.ndarray
    high: np.ndarray
    narrowest: np.ndarray


@njit_internal
def mixture(mean, sd, mass, reach, cut, floor):
    """The mixture that a step makes of masses; what is not finite has no mass.

    Rows below ``cut`` are left out, and those below ``floor`` need not be resolved.
    """
    n = mass.shape[0]
    means, sds, masses = np.zeros((n, POINTS)), np.ones((n, POINTS)), np.zeros((n, POINTS))
    low, high, narrowest = np.full(n, np.inf), np.full(n, -np.inf), np.full(n, np.inf)
    for r in range(n):
        whole = 0.0
        for i in range(POINTS):
            whole += mass[r, i]
        if not whole > cut:
            continue
        for i in range(POINTS):
            if not (mass[r, i] > 0.0 and np.isfinite(mean[r, i]) and 0.0 < sd[r, i] < np.inf):
                continue
            means[r, i], sds[r, i], masses[r, i] = mean[r, i], sd[r, i], mass[r, i]
            low[r] = min(low[r], mean[r, i] - reach * sd[r, i])
            high[r] = max(high[r], mean[r, i] + reach * sd[r, i])
            if whole > floor:
                narrowest[r] = min(narrowest[r], sd[r, i])
    return Mixture(means, sds, masses, low, high, narrowest)


@njit_internal
def narrowest_within(source, low, high):
    """(Whether any row reaches an interval, the smallest standard deviation of those that do)."""
    reached, width = False, np.inf
    for r in range(source.low.size):
        if source.low[r] <= high and source.high[r] >= low:
            reached = True
            width = min(width, source.narrowest[r])
    return reached, width


@njit_internal
def points_of(low, high, out):
    """Write the points of a segment."""
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    for i in range(POINTS):
        out[i] = centre + half * NODES[i]


@njit_internal
def weight(low, high, i):
    """The quadrature weight of point i."""
    return 0.5 * (high - low) * WEIGHTS[i]


@njit_internal
def density(source, low, high, x, out):
    """Write the density of a mixture at the points x of a segment."""
    out[:] = 0.0
    for r in range(source.low.size):
        if not (source.low[r] <= high and source.high[r] >= low):
            continue
        for i in range(POINTS):
            mean, precision = source.mean[r, i], 1.0 / source.sd[r, i]
            height = source.mass[r, i] * precision * _ONE_OVER_ROOT_TWO_PI
            for b in range(POINTS):
                z = (x[b] - mean) * precision
                out[b] += height * exp(-0.5 * z * z)


@njit_internal
def mean_over_gaussian(lows, highs, values, mean, sd, reach):
    """The integral of a function, given at all points of the segments, times N(mean, sd^2)."""
    result, precision = 0.0, 1.0 / sd
    for p in range(lows.size):
        if not (lows[p] <= mean + reach * sd and highs[p] >= mean - reach * sd):
            continue
        centre, half = 0.5 * (lows[p] + highs[p]), 0.5 * (highs[p] - lows[p])
        part = 0.0
        for b in range(POINTS):
            z = (centre + half * NODES[b] - mean) * precision
            part += WEIGHTS[b] * exp(-0.5 * z * z) * values[p, b]
        result += half * part
    return result * precision * _ONE_OVER_ROOT_TWO_PI


@njit_internal
def tail(values):
    """The largest of the last coefficients of the Legendre series of a function on a segment."""
    largest = 0.0
    for degree in range(POINTS - _TAIL, POINTS):
        coefficient = 0.0
        for i in range(POINTS):
            coefficient += _SERIES[degree, i] * values[i]
        largest = max(largest, abs(coefficient))
    return largest


@njit_internal
def polynomial(values, v):
    """The polynomial through values at the points of a segment, at a place v in [-1, 1]."""
    total, before, now = 0.0, 0.0, 1.0
    for degree in range(POINTS):
        coefficient = 0.0
        for i in range(POINTS):
            coefficient += _SERIES[degree, i] * values[i]
        total += coefficient * now
        before, now = now, ((2 * degree + 1) * v * now - degree * before) / (degree + 1)
    return total


@njit_internal
def moments(lows, highs, mass):
    """Mean and standard deviation; the masses need not sum to one."""
    x, whole, mean = np.empty((lows.size, POINTS)), 0.0, 0.0
    for p in range(lows.size):
        points_of(lows[p], highs[p], x[p])
        for i in range(POINTS):
            whole += mass[p, i]
            mean += mass[p, i] * x[p, i]
    mean /= whole
    variance = 0.0
    for p in range(lows.size):
        for i in range(POINTS):
            variance += mass[p, i] * (x[p, i] - mean) ** 2
    return mean, math.sqrt(variance / whole)


@njit_internal
def draw(lows, highs, mass, u):
    """Invert the distribution function at u, in (0, 1); the segments are in ascending order."""
    wanted = u * mass.sum()
    last = 0
    for p in range(lows.size):
        inside = mass[p].sum()
        if inside > 0.0:
            last = p
            if inside >= wanted:
                break
            wanted -= inside
    low, high = lows[last], highs[last]
    if low == high:
        return low
    return 0.5 * (low + high) + 0.5 * (high - low) * _position(mass[last], wanted)


@njit_internal
def _position(mass, wanted):
    """The v in [-1, 1] up to which the series of the density on a segment has the mass wanted."""
    series = np.zeros(POINTS)
    for degree in range(POINTS):
        for i in range(POINTS):
            series[degree] += _SERIES[degree, i] * mass[i] / WEIGHTS[i]
    low, high = -1.0, 1.0
    for _ in range(_HALVINGS):
        v = 0.5 * (low + high)
        before, now = 1.0, v
        integral = series[0] * (v + 1.0)
        for degree in range(1, POINTS):
            after = ((2 * degree + 1) * v * now - degree * before) / (degree + 1)
            integral += series[degree] * (after - before) / (2 * degree + 1)
            before, now = now, after
        if integral < wanted:
            low = v
        else:
            high = v
    return 0.5 * (low + high)
