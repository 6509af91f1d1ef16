"""The law of the state from which a pass begins: that at step 0, or one that an earlier run left.

What is left is the density itself, to its last bit: masses on a grid, or on segments. A vector
holds it behind its step: the kind, how many points or segments, where the grid begins and its
spacing, then masses, or both ends of each segment and its masses.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...compiler.native.jit import copy_into, njit_internal
from ..outcomes import NONE
from ..state_law import StateLaw
from .bisection import empty_segments
from .grid import MAX_POINTS, normalise
from .moments import mean_and_sd
from .recursion import initial_moments
from .segments import (
    MAX_SEGMENTS,
    NODES,
    POINTS,
    WEIGHTS,
    moments,
    points_of,
    polynomial,
    weight,
)

AT_START, OF_GRID, OF_SEGMENTS = range(3)

_HEADER = 5  # step, kind, count, beginning and spacing of the grid
_OF_SEGMENT = 2 + POINTS
STATE_SIZE = _HEADER + max(MAX_POINTS, MAX_SEGMENTS * _OF_SEGMENT)
"""Length of the vector that holds a law."""

_TAIL = 1e-6  # of the largest mass; below it, what is between the points follows from logs
_FINER = 4  # points in place of one, where states are drawn


class Law(NamedTuple):
    """A law at step ``k``: its kind, its mean and its standard deviation.

    Masses (1, n) are those of a grid from its point ``first`` on, or (n, 16) those of segments from
    ``low`` to ``high``. At the start there are none.
    """

    k: np.int64
    kind: np.int64
    mean: float
    sd: float
    first: np.int64
    spacing: float
    low: np.ndarray
    high: np.ndarray
    mass: np.ndarray


@njit_internal
def law_before(system, state):
    """The law that a state of the filter holds; where there is none, the Gaussian at step 0."""
    if state.size == 0:
        (mean, sd), none = initial_moments(system), np.empty(0)
        return Law(
            np.int64(0), np.int64(AT_START), mean, sd, np.int64(0), 1.0, none, none,
            np.empty((0, 0)),
        )  # fmt: skip
    k, kind, n = np.int64(state[0]), np.int64(state[1]), np.int64(state[2])
    first, spacing, values = np.int64(state[3]), state[4], state[_HEADER:]
    low, high = np.empty(n), np.empty(n)
    if kind == OF_GRID:
        mass = values[:n].copy().reshape(1, n)
        mean, sd = mean_and_sd(first, spacing, mass[0])
        return Law(k, kind, mean, sd, first, spacing, low, high, mass)
    mass = np.empty((n, POINTS))
    for p in range(n):
        row = values[p * _OF_SEGMENT : (p + 1) * _OF_SEGMENT]
        low[p], high[p] = row[0], row[1]
        copy_into(mass[p], row[2:])
    mean, sd = moments(low, high, mass)
    return Law(k, kind, mean, sd, first, spacing, low, high, mass)


@njit_internal
def is_law(state):
    """Whether a vector is a state of the filter, perhaps without the room behind it."""
    if not _HEADER < state.size <= STATE_SIZE:
        return False
    size = 1 if state[1] == OF_GRID else _OF_SEGMENT
    return 1 <= state[2] <= (state.size - _HEADER) // size


@njit_internal
def leave_grid(state, k, grid):
    """Write the law on a grid at step k."""
    first, spacing, mass = grid
    state[0], state[1], state[2], state[3], state[4] = k, OF_GRID, mass.size, first, spacing
    copy_into(state[_HEADER : _HEADER + mass.size], mass)


@njit_internal
def leave_segments(state, k, segments):
    """Write the law on segments at step k."""
    n = segments.low.size
    state[0], state[1], state[2], state[3], state[4] = k, OF_SEGMENTS, n, 0.0, 1.0
    for p in range(n):
        row = state[_HEADER + p * _OF_SEGMENT : _HEADER + (p + 1) * _OF_SEGMENT]
        row[0], row[1] = segments.low[p], segments.high[p]
        copy_into(row[2:], segments.mass[p])


@njit_internal
def _between(mass, largest, x):
    """The mass at a place x between the points 0 .. n - 1 of a grid, per spacing of the grid.

    A density that the grid resolves has no spectrum beyond half of its frequency, so that the sum
    over all points is exact. Its rounding error is that of the largest mass: in the tails a
    parabola through the logs of three masses is taken.
    """
    near = min(max(np.int64(round(x)), 0), mass.size - 1)
    away = x - near
    if abs(away) < 1e-9:
        return mass[near]
    value, sign = 0.0, 1.0
    for i in range(mass.size):
        value += sign * mass[i] / (x - i)
        sign = -sign
    value *= math.sin(math.pi * x) / math.pi
    if value > _TAIL * largest:
        return value
    near = min(max(near, 1), mass.size - 2)
    away = x - near
    before, here, after = mass[near - 1], mass[near], mass[near + 1]
    if not (before > 0.0 and here > 0.0 and after > 0.0):
        return max(here, 0.0)
    rise, fall = math.log(after / here), math.log(before / here)
    return here * math.exp(0.5 * away * ((rise - fall) + away * (rise + fall)))


@njit_internal
def grid_of(law, spacing):
    """The grid of a law on a grid, with at most this spacing; none if it has too many points."""
    mass, coarse = law.mass[0], law.spacing
    if mass.size == 1 or spacing >= coarse:
        return law.first, coarse, mass.copy()
    first = np.int64(math.ceil(law.first * coarse / spacing))
    last = np.int64(math.floor((law.first + mass.size - 1) * coarse / spacing))
    n, largest = last - first + 1, mass.max()
    finer = np.empty(n if n <= MAX_POINTS else 0)
    for i in range(finer.size):
        finer[i] = _between(mass, largest, (first + i) * spacing / coarse - law.first)
    normalise(finer)
    return first, spacing, finer


@njit_internal
def on_segments(law):
    """The same law on segments; that at the start is left as it is."""
    if law.kind != OF_GRID:
        return law
    mass, h, begin = law.mass[0], law.spacing, law.first * law.spacing
    n = -(-(mass.size - 1) // max(4, -(-mass.size // MAX_SEGMENTS)))
    low, high, masses = np.empty(max(n, 1)), np.empty(max(n, 1)), np.zeros((max(n, 1), POINTS))
    width, largest, x = (mass.size - 1) * h / max(n, 1), mass.max(), np.empty(POINTS)
    for p in range(low.size):
        low[p], high[p] = begin + p * width, begin + (p + 1) * width
        points_of(low[p], high[p], x)
        for i in range(POINTS if n else 0):
            masses[p, i] = _between(mass, largest, (x[i] - begin) / h)
            masses[p, i] *= weight(low[p], high[p], i) / h
    if n == 0:
        masses[0, 0] = 1.0
    return Law(law.k, np.int64(OF_SEGMENTS), law.mean, law.sd, law.first, h, low, high, masses)


@njit_internal
def segments_of_law(law):
    """(code, segments, number): those of a law on segments."""
    segments, n = empty_segments(MAX_SEGMENTS), law.low.size
    copy_into(segments.low[:n], law.low)
    copy_into(segments.high[:n], law.high)
    return np.int64(NONE), segments, n


@njit_internal
def density_of_law(law, low, high, x, out):
    """Write the density of a law on segments at points x of a part of one of them."""
    middle, p = 0.5 * (low + high), 0
    while p < law.low.size - 1 and law.high[p] < middle:
        p += 1
    values, centre = np.empty(POINTS), 0.5 * (law.low[p] + law.high[p])
    for i in range(POINTS):
        values[i] = law.mass[p, i] / weight(law.low[p], law.high[p], i)
    inside = law.low[p] <= middle <= law.high[p]
    for b in range(POINTS):
        out[b] = 0.0
        if inside:
            v = 2.0 * (x[b] - centre) / (law.high[p] - law.low[p])
            out[b] = max(polynomial(values, min(max(v, -1.0), 1.0)), 0.0)


def law_of_states(states: NDArray[np.float64]) -> StateLaw:
    """The laws that vectors (m, S) hold, as mixtures of narrow normals."""
    found = [_drawable(state) for state in states]
    n = max(x.size for x, _, _ in found)
    log_weights, parts = np.full((len(states), n), -np.inf), np.zeros((len(states), 2, n))
    for own, (x, width, mass) in enumerate(found):
        with np.errstate(divide="ignore"):
            log_weights[own, : x.size] = np.log(np.maximum(mass, 0.0))
        parts[own, :, : x.size] = x, width**2 / 12
    return StateLaw(log_weights, parts, 0, np.zeros(1, np.int64))


def _drawable(state: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Points of a law, the width of a cell around each, and its mass; none of one that failed."""
    if not np.isfinite(state[0]):
        return np.zeros(1), np.zeros(1), np.zeros(1)
    kind, n, values = int(state[1]), int(state[2]), state[_HEADER:]
    if kind == OF_SEGMENTS:
        rows = values[: n * _OF_SEGMENT].reshape(n, _OF_SEGMENT)
        half = 0.5 * (rows[:, 1] - rows[:, 0])[:, np.newaxis]
        x = rows[:, :1] + half * (1.0 + NODES)
        return x.ravel(), (half * WEIGHTS).ravel(), rows[:, 2:].ravel()
    if n == 1:
        return np.full(1, state[3] * state[4]), np.zeros(1), np.ones(1)
    x = (state[3] + np.arange(_FINER * n) / _FINER) * state[4]
    finer = np.fft.irfft(np.fft.rfft(values[:n]), _FINER * n)
    return x, np.full(x.size, state[4] / _FINER), finer
