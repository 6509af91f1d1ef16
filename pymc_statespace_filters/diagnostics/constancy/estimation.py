"""The posterior modes of many data sets at once, by Newton's method with the information matrix.

The curvature of the terms is that of their scores' products, whose mean is the same (the
information equality); the mode is where the scores and the gradient of everything else cancel.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...pymc_model.term_scores import ScoredVariable, Scores

# Newton steps at most; length of the last one in standard deviations, to which the scores are
# projected on the mode in any case.
N_STEPS, SETTLED = 30, 0.05
LONGEST = 2.0  # standard deviations, of a step
N_HALVINGS = 5
STEP = 1e-3  # standard deviations, of differences of everything else
FLOOR = 1e-9  # relative, of the eigenvalues of an information matrix

Array = NDArray[np.float64]


class Modes(NamedTuple):
    """Posterior modes x (m, k_x) of m data sets, and the scores there."""

    x: Array
    scores: Scores


def modes(
    variable: ScoredVariable,
    start: Array,
    observed: Array,
    scale: Array,
    information: Array | None = None,
) -> Modes:
    """The modes for data sets (m, J, p), from points start (m, k_x).

    ``scale`` (k,) is that of theta. ``information`` (k_x, k_x) is the expected one; by default
    each data set has that of its own scores, at each step.
    """
    x, value = start.copy(), _log_density(variable, start, observed)
    moving = np.arange(len(x))
    for _ in range(N_STEPS):
        own = observed[moving]
        scores = variable.scores(x[moving], own, scale)
        step = _newton_step(variable, x[moving], scores, information)
        x[moving], new = _climbing(variable, x[moving], step, value[moving], own)
        gain, value[moving] = new - value[moving], new
        moving = moving[gain > SETTLED**2 / 2]
        if not moving.size:
            break
    return Modes(x, variable.scores(x, observed, scale))


def expected_information(scores: Scores) -> Array:
    """The mean over data sets of the products of scores, (k_x, k_x)."""
    return np.einsum("mjx,mjy->xy", scores.by_x, scores.by_x) / len(scores.by_x)


def _log_density(variable: ScoredVariable, x: Array, observed: Array) -> Array:
    found = variable.other_density(x) + variable.terms(variable.theta(x), observed).sum(axis=1)
    return np.where(np.isnan(found), -np.inf, found)


def _newton_step(
    variable: ScoredVariable, x: Array, scores: Scores, information: Array | None
) -> Array:
    """Steps (m, k_x) towards the modes, of a limited length."""
    products = (
        np.einsum("mjx,mjy->mxy", scores.by_x, scores.by_x)
        if information is None
        else np.broadcast_to(information, (len(x), *information.shape))
    )
    gradient, curvature = _of_others(variable, x)
    gradient = gradient + scores.by_x.sum(axis=1)
    eigenvalues, axes = np.linalg.eigh(products + curvature)
    eigenvalues = np.maximum(np.abs(eigenvalues), FLOOR * np.abs(eigenvalues).max())
    along = np.einsum("mxa,mx->ma", axes, gradient) / np.sqrt(eigenvalues)
    along /= np.maximum(1.0, np.linalg.norm(along, axis=1, keepdims=True) / LONGEST)
    return np.asarray(np.einsum("mxa,ma->mx", axes, along / np.sqrt(eigenvalues)))


def _of_others(variable: ScoredVariable, x: Array) -> tuple[Array, Array]:
    """Gradient (m, k_x), and curvature along each axis (m, k_x, k_x), of everything else."""
    m, k = x.shape
    moves = STEP * np.eye(k)
    up, here, down = (
        variable.other_density((x[:, None] + t * moves).reshape(-1, k)).reshape(m, k)
        for t in (1, 0, -1)
    )
    gradient, second = (up - down) / (2 * STEP), (up - 2 * here + down) / STEP**2
    return gradient, np.maximum(-second, 0.0)[..., None] * np.eye(k)


def _climbing(
    variable: ScoredVariable, x: Array, step: Array, value: Array, observed: Array
) -> tuple[Array, Array]:
    """Points and values after a step, shortened where the density would fall."""
    found, best = x.copy(), value.copy()
    pending = np.arange(len(x))
    for halving in range(N_HALVINGS):
        tried = x[pending] + step[pending] / 2**halving
        new = _log_density(variable, tried, observed[pending])
        better = new >= best[pending]
        found[pending[better]], best[pending[better]] = tried[better], new[better]
        pending = pending[~better]
        if not pending.size:
            break
    return found, best
