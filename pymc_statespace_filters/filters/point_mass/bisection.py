"""One step on segments: predict, observe, and bisect until all functions are resolved."""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.numerics.order import stable_order
from ..observation_failures import observation_failure
from ..outcomes import GRID_TOO_LARGE, NO_PROCESS_NOISE, NONE, STATE_NOT_FINITE, ZERO_DENSITY
from ..plan import log_density, step_moments
from .recursion import TOO_SHORT
from .segments import MAX_SEGMENTS, POINTS, narrowest_within, points_of, tail, weight

# Of a segment, in standard deviations of the noise: of the step before, and of the next one.
_WIDEST = 4.0
_DEPTH = 2200  # bisections of the range of doubles
_ROUNDING = 1e-14  # of a log-likelihood and of a point, relative
_MOST_ROUNDING = 1e-3  # where log-likelihoods are large, far from the peak of a fine sensor
_RESOLVED, _SPLIT, _NO_NOISE = range(3)


class Accuracy(NamedTuple):
    """What is resolved: to ``relative`` on each segment, unless its mass is below ``floor``.

    A likelihood that exceeds its mean by more than ``most_surprise``, as logs, weighs masses that
    the reach has cut off.
    """

    relative: float
    floor: float
    most_surprise: float


class Step(NamedTuple):
    """Where and when: the step, what is observed (or not), and whether another step follows."""

    k: int
    t: float
    d: np.ndarray
    observes: bool
    moves: bool


class Segments(NamedTuple):
    """Segments in ascending order: predicted and updated masses, and the step from every point.

    ``log_likelihood`` is zero without an observation and -inf where the sensor has no density.
    """

    low: np.ndarray
    high: np.ndarray
    predicted: np.ndarray
    mass: np.ndarray
    log_likelihood: np.ndarray
    mean: np.ndarray
    sd: np.ndarray


@njit_internal
def _rows(n):
    return np.empty((n, POINTS))


@njit_internal
def empty_segments(n):
    """Segments without values."""
    return Segments(np.empty(n), np.empty(n), _rows(n), _rows(n), _rows(n), _rows(n), _rows(n))


@njit_internal
def known_point(system, step, x):
    """The segment without width of a state known exactly, whose first point has all mass."""
    segments = empty_segments(1)
    segments.low[0] = segments.high[0] = x
    X = np.full((1, POINTS), x)
    _functions_at(system, step, X, segments, np.zeros(1, np.int64))
    segments.predicted[:], segments.mass[:] = 0.0, 0.0
    segments.predicted[0, 0] = segments.mass[0, 0] = 1.0
    term = segments.log_likelihood[0, 0]
    return NONE if term > -np.inf else _failure(system, step, X), segments, term


@njit_internal
def resolved_segments(system, step, first_segments, density, source, accuracy):
    """(code, segments, log p(d_j | d_1 ..)) of the density of ``source`` times the likelihood.

    The field ``predicted`` holds densities until the end, then masses.
    """
    code, segments, n = first_segments(source)
    if code != NONE:
        return code, segments, -np.inf
    fresh = np.arange(n)
    while True:
        X = np.empty((1, fresh.size * POINTS))
        for f in range(fresh.size):
            p, x = fresh[f], X[0, f * POINTS : (f + 1) * POINTS]
            points_of(segments.low[p], segments.high[p], x)
            density(source, segments.low[p], segments.high[p], x, segments.predicted[p])
        _functions_at(system, step, X, segments, fresh)
        top = _top(segments, n)
        if top == -np.inf:
            return _failure(system, step, X), segments, top
        total = _weigh(segments, n, top)
        before = n
        split = np.zeros(n, np.bool_)
        for p in range(before):
            verdict = _verdict(segments, p, step, top, total, accuracy)
            if verdict == _NO_NOISE:
                return NO_PROCESS_NOISE, segments, top
            split[p] = verdict == _SPLIT
        count = split.sum()
        if count == 0:
            break
        if n + count > MAX_SEGMENTS:
            surprise = segments.log_likelihood[:n].max() - top - math.log(total)
            code = TOO_SHORT if surprise > accuracy.most_surprise else GRID_TOO_LARGE
            return code, segments, top
        fresh, f = np.empty(2 * count, np.int64), 0
        for p in range(before):
            if split[p]:
                segments.low[n], segments.high[n] = (
                    0.5 * (segments.low[p] + segments.high[p]),
                    segments.high[p],
                )
                segments.high[p] = segments.low[n]
                fresh[f], fresh[f + 1] = p, n
                f, n = f + 2, n + 1
    return NONE, _in_order(segments, n, total), top + math.log(total)


@njit_internal
def segments_of_mixture(source):
    """(code, segments, number): as narrow as the noise, where the source reaches."""
    segments, n = empty_segments(MAX_SEGMENTS), 0
    low, high = np.empty(_DEPTH), np.empty(_DEPTH)
    low[0], high[0], depth = source.low.min(), source.high.max(), 1
    if not low[0] < high[0]:
        return STATE_NOT_FINITE, segments, n
    if not high[0] - low[0] < np.inf:
        return GRID_TOO_LARGE, segments, n
    while depth > 0:
        depth -= 1
        a, b = low[depth], high[depth]
        reached, narrowest = narrowest_within(source, a, b)
        middle = 0.5 * (a + b)
        if not reached:
            continue
        if b - a > _WIDEST * narrowest and a < middle < b:
            low[depth], high[depth] = middle, b
            low[depth + 1], high[depth + 1] = a, middle
            depth += 2
            continue
        if n == MAX_SEGMENTS:
            return GRID_TOO_LARGE, segments, n
        segments.low[n], segments.high[n] = a, b
        n += 1
    return NONE, segments, n


@njit_internal
def _functions_at(system, step, X, segments, fresh):
    """Write the log-likelihood of fresh segments, and the step from their points X."""
    if step.observes:
        values = np.empty(X.shape[1])
        log_density(system, step.k, step.t, step.d, X, values)
        for f in range(fresh.size):
            for i in range(POINTS):
                value = values[f * POINTS + i]
                segments.log_likelihood[fresh[f], i] = value if abs(value) < np.inf else -np.inf
    else:
        for p in fresh:
            segments.log_likelihood[p, :] = 0.0
    if step.moves:
        M = np.empty((2, X.shape[1]))
        step_moments(system, step.k, step.t, X, M)
        for f in range(fresh.size):
            for i in range(POINTS):
                segments.mean[fresh[f], i] = M[0, f * POINTS + i]
                segments.sd[fresh[f], i] = math.sqrt(M[1, f * POINTS + i])


@njit_internal
def _failure(system, step, X):
    """Why no point has a density."""
    if not step.observes:
        return np.int64(ZERO_DENSITY)
    return observation_failure(system, step.k, step.t, step.d, X)


@njit_internal
def _top(segments, n):
    """The largest log of density times likelihood."""
    top = -np.inf
    for p in range(n):
        for i in range(POINTS):
            if segments.predicted[p, i] > 0.0:
                top = max(top, math.log(segments.predicted[p, i]) + segments.log_likelihood[p, i])
    return top


@njit_internal
def _weigh(segments, n, top):
    """Write density times likelihood over the largest into ``mass``; return the integral."""
    total = 0.0
    for p in range(n):
        for i in range(POINTS):
            value = 0.0
            if segments.predicted[p, i] > 0.0:
                log_value = math.log(segments.predicted[p, i]) + segments.log_likelihood[p, i]
                value = math.exp(log_value - top)
            segments.mass[p, i] = value
            total += value * weight(segments.low[p], segments.high[p], i)
    return total


@njit_internal
def _verdict(segments, p, step, top, total, accuracy):
    """Whether a segment must be split: it matters, and a function on it is not a polynomial."""
    a, b = segments.low[p], segments.high[p]
    if b - a <= _ROUNDING * max(abs(a), abs(b)):
        return _RESOLVED
    least = accuracy.floor * total / (b - a)
    largest, size = 0.0, 0.0
    for i in range(POINTS):
        largest = max(largest, segments.mass[p, i])
        if segments.mass[p, i] > 0.0:
            size = max(size, abs(segments.log_likelihood[p, i]))
    if largest <= least:
        # The peak of a fine sensor may lie between the points.
        hides_peak = step.observes and _may_matter(segments, p, top, least)
        return _SPLIT if hides_peak else _RESOLVED
    rounding = min(_ROUNDING * (size + max(abs(a), abs(b)) / (b - a)), _MOST_ROUNDING)
    if tail(segments.mass[p]) > (accuracy.relative + rounding) * largest:
        return _SPLIT
    if step.moves:
        return _verdict_on_step(segments.mean[p], segments.sd[p], accuracy.relative)
    return _RESOLVED


@njit_internal
def _may_matter(segments, p, top, least):
    """Whether density times likelihood may exceed ``least``, even between the points."""
    highest, rise, denser = -np.inf, 0.0, 0.0
    for i in range(POINTS):
        here = segments.log_likelihood[p, i]
        denser = max(denser, segments.predicted[p, i])
        highest = max(highest, here)
        if i > 0 and here > -np.inf and segments.log_likelihood[p, i - 1] > -np.inf:
            rise = max(rise, abs(here - segments.log_likelihood[p, i - 1]))
    if highest == -np.inf or denser == 0.0:
        return False
    return math.log(denser) + highest + rise - top > math.log(least)


@njit_internal
def _verdict_on_step(mean, sd, relative):
    """The same for the transition from a segment, which may leave a function's domain."""
    finite, still = 0, 0
    lowest, highest, narrowest = np.inf, -np.inf, np.inf
    for i in range(POINTS):
        if np.isfinite(mean[i]) and np.isfinite(sd[i]):
            finite += 1
            still += sd[i] == 0.0
            lowest, highest = min(lowest, mean[i]), max(highest, mean[i])
            narrowest = min(narrowest, sd[i])
    if finite == 0:
        return _RESOLVED
    if finite == still:
        return _NO_NOISE
    if finite < POINTS or still > 0 or highest - lowest > _WIDEST * narrowest:
        return _SPLIT
    bound = relative * narrowest + _ROUNDING * max(abs(lowest), abs(highest))
    return _SPLIT if tail(mean) > bound or tail(sd) > bound else _RESOLVED


@njit_internal
def _in_order(segments, n, total):
    """The first n segments in ascending order, with masses in the place of densities."""
    out = empty_segments(n)
    order = stable_order(segments.low[:n])
    whole = 0.0
    for p in range(n):
        q = order[p]
        out.low[p], out.high[p] = segments.low[q], segments.high[q]
        for i in range(POINTS):
            w = weight(out.low[p], out.high[p], i)
            out.predicted[p, i] = segments.predicted[q, i] * w
            out.mass[p, i] = segments.mass[q, i] * w / total
            out.log_likelihood[p, i] = segments.log_likelihood[q, i]
            out.mean[p, i], out.sd[p, i] = segments.mean[q, i], segments.sd[q, i]
            whole += out.predicted[p, i]
    for p in range(n):
        for i in range(POINTS):
            out.predicted[p, i] /= whole
    return out
