"""The priors of the largest evidence: Newton's method in the log-precisions, from many starts.

The evidence has many maxima, most of them with some precisions at infinity, where a term is absent.
Where Newton's method has stopped, single precisions are therefore changed to any other value,
infinity included, as long as that helps.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .ard_evidence import ABSENT, ArdEvidence

N_STEPS, MIN_STEP = 200, 1e-7
LONGEST_STEP = 2.0  # in a log-precision
FAR = 12.0  # log-precision from which a term whose precision still grows is absent
TRIED = np.append(np.arange(-8.0, FAR), ABSENT)  # log-precisions that one term is moved to
MIN_GAIN = 1e-6  # nats
N_RANDOM = 7  # starts with every term in or out by a coin

Array = NDArray[np.float64]


def largest_evidence(evidence: ArdEvidence, rng: np.random.Generator) -> Array:
    """The log-precisions (p,) of the largest maximum found; `ABSENT` where a term is absent."""
    p = evidence.shifts.shape[1]
    found = [climb(evidence, start) for start in _starts(p, rng)]
    return max(found, key=lambda at: float(evidence.log_evidence(at)))


def largest_without(evidence: ArdEvidence, optimum: Array, term: int) -> Array:
    """The same with one term absent, from the optimum with it."""
    start = optimum.copy()
    start[term] = ABSENT
    return climb(evidence, start, np.arange(len(start)) != term)


def _starts(p: int, rng: np.random.Generator) -> Iterator[Array]:
    yield np.zeros(p)
    for _ in range(N_RANDOM):
        yield np.where(rng.random(p) < 0.5, ABSENT, 0.0)


def climb(
    evidence: ArdEvidence, log_alpha: Array, is_free: NDArray[np.bool_] | None = None
) -> Array:
    """A maximum over the free precisions that no change of a single one of them improves."""
    free = np.ones(len(log_alpha), dtype=bool) if is_free is None else is_free
    while True:
        log_alpha = newton(evidence, log_alpha)
        reached = float(evidence.log_evidence(log_alpha))
        moved = _moves(log_alpha, np.flatnonzero(free))
        values = evidence.log_evidence(moved)
        if not len(values) or values.max() < reached + MIN_GAIN:
            return log_alpha
        log_alpha = moved[values.argmax()]


def _moves(log_alpha: Array, terms: NDArray[np.int64]) -> Array:
    """One term moved to any of `TRIED`, all others where they are."""
    moved = np.repeat(log_alpha[None], len(terms) * len(TRIED), axis=0)
    moved[np.arange(len(moved)), np.repeat(terms, len(TRIED))] = np.tile(TRIED, len(terms))
    return moved


def newton(evidence: ArdEvidence, log_alpha: Array) -> Array:
    """A maximum over the terms that are present, some of which may become absent."""
    for _ in range(N_STEPS):
        value, gradient, hessian = evidence.derivatives(log_alpha)
        leaves = (log_alpha > FAR) & (gradient >= 0)
        log_alpha = np.where(leaves, ABSENT, log_alpha)
        present = log_alpha < ABSENT
        if not present.any():
            break
        step = np.zeros_like(log_alpha)
        step[present] = _ascent(gradient[present], hessian[np.ix_(present, present)])
        while np.abs(step).max() > MIN_STEP and evidence.log_evidence(log_alpha + step) < value:
            step = step / 2
        if np.abs(step).max() <= MIN_STEP:
            break
        log_alpha = log_alpha + step
    return log_alpha


def _ascent(gradient: Array, hessian: Array) -> Array:
    """Newton's step, uphill in directions of positive curvature too, and of limited length."""
    curvatures, directions = np.linalg.eigh(hessian)
    slopes = directions.T @ gradient
    # Where both are tiny, as far out, the step has the length of their ratio.
    floor = np.finfo(float).tiny + 1e-6 * np.abs(slopes)
    step = directions @ (slopes / np.maximum(np.abs(curvatures), floor))
    return np.asarray(step * min(1.0, LONGEST_STEP / max(float(np.abs(step).max()), 1e-300)))
