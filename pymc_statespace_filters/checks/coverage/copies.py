"""Whether a posterior has separate modes that chains have missed: copies of the one they are in.

Another frequency has the same likelihood where a rotation is seen once a period, another sign where
a parameter enters by its square, another order where labels may be exchanged, another turn of a
phase. Chains in one of such modes agree, and estimates of the evidence from their draws as well. So
points are evaluated where a copy may lie: the best draw with elements reflected or exchanged, and
lines from it along each element, as wide as its prior, on which the peaks are approached. Where the
density at such a point is far above that of a mixture fitted to the draws, its surroundings are
explored, and the integral over them is compared with the draws there, as in `missed_modes`. A place
that the density does not fall before belongs to the mode of the draws, and is no copy.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ...smc.kernel import fitted_mixture
from ...statistics.importance import LogMean, mcse_of_chains
from ...statistics.student_mixture import StudentMixture, standardised
from .check import bridged
from .missed_modes import MIN_EXCESS, N_PLACES, SIZES, MissedMode, Place, compared, explored
from .tail_proposals import Evaluate

N_FITTED, N_BRIDGE = 1000, 500  # draws of the mixture; points of the evidence
FEWEST, LONGEST, MOST = 60, 400, 1000  # points of a line; of all kinds, for each element
N_PEAKS, N_ZOOMS, N_ZOOM = 5, 3, 9  # of a line, that are approached; how often, with points each
LEAPS = 0.3  # of the evaluations, for points where copies may lie
N_DIP, DIP = 16, 5.0  # points between a place and the draws; nats that the density falls there

Array = NDArray[np.float64]


def missed_copy(
    draws: Array,
    log_density: Array,
    prior: Array,
    shapes: Sequence[tuple[int, ...]],
    evaluate: Evaluate,
    n_evaluations: float,
    rng: np.random.Generator,
) -> MissedMode | None:
    """Look for a mode of which chains have missed a part; the worst of those found.

    Parameters
    ----------
    draws, log_density, evaluate, n_evaluations, rng
        As of `missed_tails`.
    prior : ndarray (m, k)
        Draws of the prior, as wide as the lines.
    shapes : sequence of tuple
        Of the variables that the k elements are those of.
    """
    k = draws.shape[-1]
    n_leaps = int(min(LEAPS * n_evaluations, MOST * k))
    if n_leaps < FEWEST * k or n_evaluations < N_BRIDGE + sum(SIZES):
        return None
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # points far beyond the draws
            found = _missed(draws, log_density, prior, shapes, evaluate, n_leaps, rng)
    except np.linalg.LinAlgError:  # draws that do not vary in every direction
        return None
    return max(found, key=lambda m: m.posterior, default=None)


def _missed(
    draws: Array,
    log_density: Array,
    prior: Array,
    shapes: Sequence[tuple[int, ...]],
    evaluate: Evaluate,
    n_leaps: int,
    rng: np.random.Generator,
) -> list[MissedMode]:
    """The modes found from so many points."""
    flat = draws.reshape(-1, draws.shape[-1])
    fitted = standardised(flat[:: 1 + log_density.size // N_FITTED])
    if fitted is None:
        return []
    mixture = fitted_mixture(fitted, rng)
    at_drawn = log_density - mixture.log_density(flat).reshape(log_density.shape)
    level = float(np.median(at_drawn))

    def excess(x: Array, log_density: Array) -> Array:
        return np.asarray(log_density - mixture.log_density(x) - level)

    x, at_x = _leaps(flat[log_density.argmax()], prior, shapes, evaluate, n_leaps, rng)
    at_x[~(excess(x, at_x) > MIN_EXCESS)] = -np.inf
    if np.isneginf(at_x).all():
        return []
    log_evidence = _log_evidence(at_drawn, mixture, evaluate, rng)
    found = []
    for _ in range(N_PLACES):
        if log_evidence is None or np.isneginf(at_x[start := int(at_x.argmax())]):
            break
        place = explored(x[start], flat, excess, evaluate, rng)
        at_x[start] = -np.inf
        if place is not None:
            at_x[place.holds(x)] = -np.inf
            missed = compared(place, log_evidence, *_share(place, draws))
            if missed.is_large and _is_apart(place, fitted.chol, flat, evaluate, rng):
                found.append(missed)
    return found


def _log_evidence(
    at_drawn: Array, mixture: StudentMixture, evaluate: Evaluate, rng: np.random.Generator
) -> LogMean | None:
    """The evidence of the draws, whose densities are given relative to those of the mixture."""
    x = mixture.sample(N_BRIDGE, rng)
    return bridged(at_drawn, evaluate(x, rng) - mixture.log_density(x))


def _share(place: Place, draws: Array) -> tuple[float, float]:
    """Of the draws, in a place, and its standard error."""
    inside = place.holds(draws.reshape(-1, draws.shape[-1])).reshape(draws.shape[:2])
    share = float(inside.mean())
    return share, mcse_of_chains(inside.astype(np.float64)) if 0 < share < 1 else 0.0


def _is_apart(
    place: Place, chol: Array, x: Array, evaluate: Evaluate, rng: np.random.Generator
) -> bool:
    """Whether the density falls between a place and the nearest draw (n, k) outside of it."""
    outside = x[~place.holds(x)]
    distance = (np.linalg.solve(chol, (outside - place.centre).T) ** 2).sum(axis=0)
    if not distance.size:
        return False
    steps = np.linspace(0, 1, N_DIP)[:, np.newaxis]
    at = evaluate(place.centre + steps * (outside[distance.argmin()] - place.centre), rng)
    return bool(at.min() < min(at[0], at[-1]) - DIP)


def _leaps(
    best: Array,
    prior: Array,
    shapes: Sequence[tuple[int, ...]],
    evaluate: Evaluate,
    n: int,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Points where copies of a point may lie, about n of them, and their log-densities.

    First lines along each element; then images, and lines from those with one element reflected.
    """
    k, moves = len(best), _moves(shapes)
    per_line = min(n // k, LONGEST)
    parts = _lines(np.tile(best, (k, 1)), np.arange(k), prior, per_line, evaluate, rng)
    once = _moved(best[np.newaxis], moves)
    n -= per_line * k + len(once)
    images = np.concatenate([once, rng.permutation(_moved(once, moves))[: max(n // 2, 0)]])
    parts.append((images, evaluate(images, rng)))
    reflected, element = np.nonzero(~np.eye(k, dtype=bool))
    if len(element) and n // 2 >= FEWEST * len(element):
        per_line = min(n // 2 // len(element), LONGEST)
        parts += _lines(once[reflected], element, prior, per_line, evaluate, rng)
    x, at_x = (np.concatenate(one) for one in zip(*parts, strict=True))
    return x, at_x


def _lines(
    starts: Array,
    element: NDArray[np.intp],
    prior: Array,
    count: int,
    evaluate: Evaluate,
    rng: np.random.Generator,
) -> list[tuple[Array, Array]]:
    """So many points on each line through a start (lines, k) along its element.

    The last ones are between those at the highest peaks, but that of the start.
    """
    k, n_peaks = starts.shape[1], min(N_PEAKS, count // (2 * N_ZOOMS * N_ZOOM))
    n_even = count - n_peaks * N_ZOOMS * N_ZOOM
    grid = np.quantile(prior, np.linspace(0, 1, n_even), axis=0).T[element]  # (lines, points)
    here = starts[np.arange(len(starts)), element][:, np.newaxis]

    def along(line: NDArray[np.intp], values: Array) -> tuple[Array, Array]:
        """Points (lines, values, k) with an element replaced, and their log-densities."""
        x = np.repeat(starts[line][:, np.newaxis], values.shape[1], axis=1)
        np.put_along_axis(x, element[line][:, np.newaxis, np.newaxis], values[..., np.newaxis], 2)
        return x, evaluate(x.reshape(-1, k), rng).reshape(values.shape)

    parts = [along(np.arange(len(starts)), grid)]
    at = parts[0][1]
    low, high = grid[:, :-2], grid[:, 2:]
    is_peak = (at[:, 1:-1] >= at[:, :-2]) & (at[:, 1:-1] >= at[:, 2:]) & np.isfinite(at[:, 1:-1])
    is_peak &= (here < low) | (here > high)
    height = np.where(is_peak, at[:, 1:-1], -np.inf)
    highest = np.argsort(-height, axis=1)[:, :n_peaks]
    line, place = np.nonzero(np.take_along_axis(is_peak, highest, axis=1))
    place = highest[line, place]
    begin, end = low[line, place], high[line, place]
    for _ in range(N_ZOOMS if len(line) else 0):
        values = np.linspace(begin, end, N_ZOOM, axis=1)
        parts.append(along(line, values))
        top = parts[-1][1].argmax(axis=1)
        rows = np.arange(len(line))
        begin = values[rows, np.maximum(top - 1, 0)]
        end = values[rows, np.minimum(top + 1, N_ZOOM - 1)]
    return [(x.reshape(-1, k), at.ravel()) for x, at in parts]


def _moves(shapes: Sequence[tuple[int, ...]]) -> list[tuple[NDArray[np.intp], Array]]:
    """Orders and signs of elements: reflections of one or a variable, exchanges of two, of labels.

    An exchange of labels is one of two places of every axis that has as many.
    """
    ends = np.cumsum([0, *(int(np.prod(shape)) for shape in shapes)])
    k, same = int(ends[-1]), np.arange(int(ends[-1]))
    indices = [same[a:b].reshape(s) for a, b, s in zip(ends, ends[1:], shapes, strict=False)]
    ones = np.ones(k)
    moves = []
    for reflected in [*same[:, np.newaxis], *(i.ravel() for i in indices if i.size > 1)]:
        moves.append((same, np.where(np.isin(same, reflected), -1.0, ones)))
    for i, j in combinations(range(k), 2):
        order = same.copy()
        order[[i, j]] = j, i
        moves.append((order, ones))
    for length in sorted({n for shape in shapes for n in shape if n > 1}):
        for i, j in combinations(range(length), 2):
            order = np.arange(length)
            order[[i, j]] = j, i
            moves.append((np.concatenate([_exchanged(one, order) for one in indices]), ones))
    return moves


def _exchanged(index: NDArray[np.intp], order: NDArray[np.intp]) -> NDArray[np.intp]:
    """The flat index of a variable with all axes of this length in another order."""
    for axis, length in enumerate(index.shape):
        if length == len(order):
            index = index.take(order, axis=axis)
    return index.ravel()


def _moved(x: Array, moves: Sequence[tuple[NDArray[np.intp], Array]]) -> Array:
    """All points (n, k) moved in all ways."""
    return np.concatenate([sign * x[:, order] for order, sign in moves])
