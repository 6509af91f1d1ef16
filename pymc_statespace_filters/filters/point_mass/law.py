"""Laws of the state: that from which a pass begins, at step 0 or left by a run, and those it keeps.

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
from .bisection import Segments, empty_segments
from .grid import MAX_POINTS, grid_points, normalise
from .moments import draw as draw_on_grid
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
from .segments import draw as draw_on_segments

AT_START, OF_GRID, OF_SEGMENTS = range(3)

_HEADER = 5  # step, kind, count, beginning and spacing of the grid
_OF_SEGMENT = 2 + POINTS
STATE_SIZE = _HEADER + max(MAX_POINTS, MAX_SEGMENTS * _OF_SEGMENT)
"""Length of the vector that holds a law."""

_TAIL = 1e-6  # of the largest mass; below it, what is between the points follows from logs
_FINER = 4  # points in place of one, where states are drawn


class Law(NamedTuple):
    """A law at step ``k``: its kind, its mean and its standard deviation.

    ``parts.mass`` (1, n) are the masses of a grid from its point ``first`` on, or (n, 16) those of
    segments. At the start there are none.
    """

    k: np.int64
    kind: np.int64
    mean: float
    sd: float
    first: np.int64
    spacing: float
    parts: Segments


@njit_internal
def _of_masses(low, high, mass):
    """Segments of which nothing but the masses is known."""
    return Segments(low, high, mass, mass, mass, mass, mass)


@njit_internal
def law_at_start(mean, sd):
    """A normal law at step 0."""
    zero = np.int64(0)
    return Law(zero, np.int64(AT_START), mean, sd, zero, 1.0, empty_segments(0))


@njit_internal
def law_of_grid(k, grid):
    """The law that a grid has at step k; the grid may change later."""
    first, spacing, mass = grid
    mean, sd = mean_and_sd(first, spacing, mass)
    parts = _of_masses(np.empty(1), np.empty(1), mass.copy().reshape(1, mass.size))
    return Law(np.int64(k), np.int64(OF_GRID), mean, sd, first, spacing, parts)


@njit_internal
def law_of_segments(k, s, mass):
    """The law of these masses on segments at step k."""
    (mean, sd), kind = moments(s.low, s.high, mass), np.int64(OF_SEGMENTS)
    parts = Segments(s.low, s.high, s.predicted, mass, s.log_likelihood, s.mean, s.sd)
    return Law(np.int64(k), kind, mean, sd, np.int64(0), 1.0, parts)


@njit_internal
def law_before(system, state):
    """The law that a state of the filter holds; where there is none, the Gaussian at step 0."""
    if state.size == 0:
        mean, sd = initial_moments(system)
        return law_at_start(mean, sd)
    k, n, values = np.int64(state[0]), np.int64(state[2]), state[_HEADER:]
    if state[1] == OF_GRID:
        return law_of_grid(k, (np.int64(state[3]), state[4], values[:n]))
    segments = empty_segments(n)
    for p in range(n):
        row = values[p * _OF_SEGMENT : (p + 1) * _OF_SEGMENT]
        segments.low[p], segments.high[p] = row[0], row[1]
        copy_into(segments.mass[p], row[2:])
    return law_of_segments(k, segments, segments.mass)


@njit_internal
def is_law(state):
    """Whether a vector is a state of the filter, perhaps without the room behind it."""
    if not _HEADER < state.size <= STATE_SIZE:
        return False
    size = 1 if state[1] == OF_GRID else _OF_SEGMENT
    return 1 <= state[2] <= (state.size - _HEADER) // size


@njit_internal
def leave(state, law):
    """Write a law to a state of the filter."""
    mass = law.parts.mass
    n = mass.size if law.kind == OF_GRID else mass.shape[0]
    state[0], state[1], state[2], state[3], state[4] = law.k, law.kind, n, law.first, law.spacing
    if law.kind == OF_GRID:
        copy_into(state[_HEADER : _HEADER + n], mass[0])
        return
    for p in range(n):
        row = state[_HEADER + p * _OF_SEGMENT : _HEADER + (p + 1) * _OF_SEGMENT]
        row[0], row[1] = law.parts.low[p], law.parts.high[p]
        copy_into(row[2:], mass[p])


@njit_internal
def drawn_from(law, mass, u):
    """Invert the distribution function that these masses have, at u in (0, 1)."""
    if law.kind == OF_GRID:
        return draw_on_grid(law.first, law.spacing, mass[0], u)
    return draw_on_segments(law.parts.low, law.parts.high, mass, u)


@njit_internal
def points_of_law(law):
    """The points of all masses, (1, n)."""
    mass = law.parts.mass
    if law.kind == OF_GRID:
        return grid_points(law.first, mass.size, law.spacing)
    X = np.empty((1, mass.size))
    for p in range(mass.shape[0]):
        out = X[0, p * POINTS : (p + 1) * POINTS]
        points_of(law.parts.low[p], law.parts.high[p], out)
    return X


class Tape(NamedTuple):
    """What a pass keeps: the laws at the steps ``at``, before or after an update there."""

    laws: list[Law]
    at: np.ndarray
    is_predicted: bool


@njit_internal
def new_tape(at, is_predicted):
    """A tape without laws."""
    laws = [law_at_start(0.0, 0.0)]  # lets numba infer the type of the empty list
    laws.clear()
    return Tape(laws, at, is_predicted)


@njit_internal
def keep_grid(tape, k, grid, is_updated):
    """Keep the grid of a wanted step; the updated one in place of the predicted one."""
    n = len(tape.laws)
    if not is_updated and n < tape.at.size and tape.at[n] == k:
        tape.laws.append(law_of_grid(k, grid))
    if is_updated and not tape.is_predicted and n > 0 and tape.at[n - 1] == k:
        tape.laws[n - 1] = law_of_grid(k, grid)


@njit_internal
def keep_segments(tape, k, segments):
    """Keep the segments of a wanted step."""
    n = len(tape.laws)
    if n < tape.at.size and tape.at[n] == k:
        mass = segments.predicted if tape.is_predicted else segments.mass
        tape.laws.append(law_of_segments(k, segments, mass))


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
    mass, coarse = law.parts.mass[0], law.spacing
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
    mass, h, begin = law.parts.mass[0], law.spacing, law.first * law.spacing
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
    parts = _of_masses(low, high, masses)
    return Law(law.k, np.int64(OF_SEGMENTS), law.mean, law.sd, law.first, h, parts)


@njit_internal
def segments_of_law(law):
    """(code, segments, number): those of a law on segments."""
    segments, n = empty_segments(MAX_SEGMENTS), law.parts.low.size
    copy_into(segments.low[:n], law.parts.low)
    copy_into(segments.high[:n], law.parts.high)
    return np.int64(NONE), segments, n


@njit_internal
def density_of_law(law, low, high, x, out):
    """Write the density of a law on segments at points x of a part of one of them."""
    lows, highs, mass = law.parts.low, law.parts.high, law.parts.mass
    middle, p = 0.5 * (low + high), 0
    while p < lows.size - 1 and highs[p] < middle:
        p += 1
    values, centre = np.empty(POINTS), 0.5 * (lows[p] + highs[p])
    for i in range(POINTS):
        values[i] = mass[p, i] / weight(lows[p], highs[p], i)
    inside = lows[p] <= middle <= highs[p]
    for b in range(POINTS):
        out[b] = 0.0
        if inside:
            v = 2.0 * (x[b] - centre) / (highs[p] - lows[p])
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
