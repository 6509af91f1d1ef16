"""Separate modes of a posterior, in a population of its points.

The population is divided into groups by a mixture of Student-t distributions. Two groups belong to
one mode if the log-density between two points of theirs, close to each other, hardly falls. A
curved posterior has several groups and one mode.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pymc.model import Model
from pymc.stats.convergence import SamplerWarning, WarningType
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from ...pymc_model.density import ConstrainedValues
from ...student_mixture import fit_mixture, place_components, standardised
from ...unvisited import ALL_MODES
from ..target.variables import RaveledVariables

# With these, at most 120 evaluations of the log-density; the search for starts makes 2560 or more.
_N_GROUPS = 4
_N_LINES = 4  # between two groups
_N_PER_LINE = 5  # its ends included, as the estimates of points that stayed are too high
_DIP = 5.0  # nats below the lower end of each line, between separate modes
_LEAST_SHARE = 0.02  # of the points; fewer have only not moved yet
_APART = 2.0  # standard deviations within the modes: variables that differ between them
_MOST_NAMED = 4  # variables in the message
_N_COMPARED = 50  # points of each mode, whose means are compared

_LABELS = (
    " They have the same values in another order, as if labels were exchanged, such as those of "
    "regimes. If they may be, the modes are one: keep an order of a vector of them "
    "(transform=pm.distributions.transforms.ordered, initval=increasing values)."
)

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


def modes_message(model: Model, raveled: RaveledVariables, points: Points) -> str | None:
    """Describe the modes, if there are several: where they are highest, and their shares."""
    numbers, counts = np.unique(points.mode, return_counts=True)
    shares = counts / len(points.mode)
    large = sorted(np.flatnonzero(shares >= _LEAST_SHARE), key=lambda i: -shares[i])
    if len(large) < 2:
        return None
    members = [np.flatnonzero(points.mode == numbers[i]) for i in large]
    highest = [of_mode[points.log_density[of_mode].argmax()] for of_mode in members]
    names = _differing(model, raveled, [points.x[of_mode] for of_mode in members])
    at = ConstrainedValues(model)
    values = [at(points.x[i]) for i in highest]
    described = [
        f"at {', '.join(f'{name}={_short(value[name])}' for name in names)} "
        f"(share {shares[i]:.2f}, log-density {points.log_density[top]:.1f})"
        for i, top, value in zip(large, highest, values, strict=True)
    ]
    of_modes = [[at(x) for x in points.x[some[:_N_COMPARED]]] for some in members]
    advice = _LABELS if _are_orders(of_modes) else f" {ALL_MODES[0].upper()}{ALL_MODES[1:]}."
    return (
        f"The posterior has {len(large)} separate modes: {' and '.join(described)}. A mean over "
        f"all modes may lie in none of them.{advice}"
    )


def is_reordered(one: Array, other: Array, tolerance: Array) -> bool:
    """Whether two points (n,) have the same numbers in different places, within the other's errors.

    A number has the tolerance of the place that it has there: that of a parameter which is poorly
    known would take others for equal.
    """
    differs = np.abs(one[:, None] - other) > tolerance
    return not differs[linear_sum_assignment(differs)].any()


def _are_orders(modes: Sequence[Sequence[Mapping[str, Array]]]) -> bool:
    """Whether each mode, given by some of its points, has the values of the first, reordered.

    Values change places within their variable, or among the scalar variables.
    """
    first, *others = modes
    names = list(first[0])
    scalars = [name for name in names if np.ndim(first[0][name]) == 0]
    groups = [[name] for name in names if name not in scalars] + ([scalars] if scalars else [])
    return all(_is_order(first, other, group) for other in others for group in groups)


def _is_order(
    one: Sequence[Mapping[str, Array]], other: Sequence[Mapping[str, Array]], names: list[str]
) -> bool:
    values = [
        np.array([np.concatenate([np.ravel(x[name]) for name in names]) for x in mode])
        for mode in (one, other)
    ]
    (first, second), spread = (x.mean(axis=0) for x in values), [x.std(axis=0) for x in values]
    return is_reordered(first, second, np.maximum(*spread))


def modes_warning(message: str) -> SamplerWarning:
    """Make a warning for PyMC's logger."""
    return SamplerWarning(WarningType.CONVERGENCE, message, "warn")


def _differing(model: Model, raveled: RaveledVariables, modes: list[Array]) -> list[str]:
    """The variables that differ between modes, the most different first."""
    means = np.array([x.mean(axis=0) for x in modes])
    within = np.min([x.std(axis=0) for x in modes], axis=0)  # one may be several, further out
    apart = np.ptp(means, axis=0) / np.where(within > 0, within, np.inf)
    order = np.argsort(-apart)
    chosen = [i for i in order if apart[i] > _APART] or [order[0]]
    return list(dict.fromkeys(raveled.rv_at(model, int(i)).name for i in chosen))[:_MOST_NAMED]


def _short(value: Array) -> str:
    return np.array2string(np.asarray(value), precision=3, threshold=6, edgeitems=2)
