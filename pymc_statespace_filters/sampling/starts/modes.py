"""Separate modes of a posterior, in a population of its points.

The population is divided into groups by a mixture of Student-t distributions. Two groups belong to
one mode if the log-density between two points of theirs, close to each other, hardly falls. A
curved posterior has several groups and one mode.
"""

from collections.abc import Callable
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from ...statistics.student_mixture import fit_mixture, place_components, standardised

# With these, at most 120 evaluations of the log-density; the search for starts makes 2560 or more.
_N_GROUPS = 4
_N_LINES = 4  # between two groups
_N_PER_LINE = 5  # its ends included, as the estimates of points that stayed are too high
_DIP = 5.0  # nats below the lower end of each line, between separate modes

Array = NDArray[np.float64]


class Points(NamedTuple):
    """Points (m, d) of a posterior, their log-densities (m,), and the numbers of their modes."""

    x: Array
    log_density: Array
    mode: NDArray[np.intp]


def find_modes(
    x: Array, evaluate: Callable[[Array], Array], rng: np.random.Generator
) -> NDArray[np.intp]:
    """The number of the mode of each point; of few points or one mode, 0.

    ``evaluate`` gives the log-densities at points (m, d).
    """
    points = standardised(x) if len(x) > x.shape[1] else None
    if points is None:
        return np.zeros(len(x), dtype=np.intp)
    mixture = fit_mixture(points.z, place_components(points.z, _N_GROUPS, rng))
    group = mixture.log_joint(points.z).argmax(axis=0)
    lines = {
        pair: _shortest_lines(points.z, *(np.flatnonzero(group == g) for g in pair))
        for pair in combinations(np.unique(group), 2)
    }
    mode = group.copy()
    for pair in sorted(lines, key=lambda pair: lines[pair].length):
        first, second = (mode[np.argmax(group == g)] for g in pair)
        if first != second and _is_connected(lines[pair], x, evaluate):
            mode[mode == second] = first
    return mode


class _Lines(NamedTuple):
    begin: NDArray[np.intp]
    end: NDArray[np.intp]
    length: float  # of the shortest


def _shortest_lines(x: Array, first: NDArray[np.intp], second: NDArray[np.intp]) -> _Lines:
    """Lines from different points of a group to the closest ones of another."""
    _, distinct = np.unique(x[first], axis=0, return_index=True)
    first = first[distinct]
    distances = cdist(x[first], x[second])
    shortest = distances.min(axis=1)
    chosen = np.argsort(shortest)[:_N_LINES]
    return _Lines(first[chosen], second[distances[chosen].argmin(axis=1)], float(shortest.min()))


def _is_connected(lines: _Lines, x: Array, evaluate: Callable[[Array], Array]) -> bool:
    fractions = np.linspace(0.0, 1.0, _N_PER_LINE)[:, np.newaxis, np.newaxis]
    points = x[lines.begin] + fractions * (x[lines.end] - x[lines.begin])
    log_density = evaluate(points.reshape(-1, x.shape[1])).reshape(_N_PER_LINE, -1)
    ends = np.minimum(log_density[0], log_density[-1])
    return bool((log_density[1:-1].min(axis=0) >= ends - _DIP).any())


def is_reordered(one: Array, other: Array, tolerance: Array) -> bool:
    """Whether two points (n,) have the same numbers in different places, within the other's errors.

    A number has the tolerance of the place that it has there: that of a parameter which is poorly
    known would take others for equal.
    """
    differs = np.abs(one[:, None] - other) > tolerance
    return not differs[linear_sum_assignment(differs)].any()
