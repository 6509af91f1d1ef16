"""The maximum of a deterministic likelihood, by Newton's method from several points.

Each search starts at a point of a population in the posterior, and its coordinates are scaled by
the width of the likelihood there, which may be much smaller than that of the population if this has
several modes. The best maximum is then refined, in coordinates in which the curvature is one, with
derivatives of fourth order.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from ..evidence.estimators.largest_likelihood import maximize_along_edge
from ..evidence.estimators.newton import (
    BatchFunction,
    EdgeError,
    along,
    derivatives,
    newton_maximize,
)
from ..sampling.starts.annealing import Population
from .estimate import EDGE, INCREASING, LEVEL, Lost, Peak, unconstrained_hessian

N_STARTS = 5
LENGTHS = 4.0 ** -np.arange(12)  # tried for a scale, relative to the population
MAX_CHANGE = 1.0  # nats, of the log-likelihood along a scale
STEP = 0.02  # of the fine differences, in standard errors; doubled for the coarse
N_REFINED, N_RESCALED = 10, 3  # most Newton steps of the refinement; those that change the scale
SETTLED = 1e-6  # standard errors, of a Newton step
RESCALING = 0.01, 1e4  # least and most curvature that a rescaling trusts
MAX_LENGTH = 3.0  # of a scale, in standard deviations of the population
MIN_CURVATURE = 0.3  # below, a direction is probed
PROBES, MIN_FALL = (0.5, 1.0, 2.0, 4.0), 0.01  # distances in scales; nats
# Points a tiny move from a probe, of which hardly all have the same rounding error; nats that do
# not matter; a gain that is trusted, in rounding errors.
N_TWINS, TWIN, ROUNDING, TRUSTED = 12, 1e-10, 1e-9, 100.0
N_MOVES, MIN_GAIN = 5, 1e-10  # most moves towards a bound; nats, of a move that is worth it
MAX_DECREMENT = 0.01  # standard errors, of the Newton step that remains
RIVAL_NATS, RIVAL_DISTANCE = 2.0, 5.0  # below the maximum; standard errors from it
MAX_RUGGEDNESS = 0.1  # change of the curvature by a doubled step

Array = NDArray[np.float64]


class _Local(NamedTuple):
    """Derivatives at a point, in coordinates z of x = point + scale z."""

    point: Array  # (k,)
    value: float
    scale: Array  # (k, r)
    gradient: Array  # (r,)
    hessian: Array  # (r, r)
    ruggedness: float

    def spectrum(self) -> tuple[Array, Array]:
        """Curvatures (r,) and their directions (r, r), in columns."""
        return np.linalg.eigh(-self.hessian)


def maximize_smooth(log_likelihood: BatchFunction, population: Population) -> Peak:
    """Find the largest maximum of a deterministic log-likelihood."""
    spread = population_scale(population.x)
    found = []
    for start in _starts(population, spread):
        scale = _fitting(log_likelihood, start, spread)
        largest = newton_maximize(along(log_likelihood, start, scale), np.zeros(len(start)))
        z, value = largest.point, largest.value
        if largest.at_edge:
            value, z = maximize_along_edge(along(log_likelihood, start, scale), z)
        found.append((value, start + scale @ z))
    _, point = max(found, key=lambda one: one[0])
    peak = _peak(log_likelihood, point, spread)
    return peak._replace(rivals=tuple(_rivals(found, peak)))


def _rivals(found: list[tuple[float, Array]], peak: Peak) -> Iterator[tuple[Array, float]]:
    """Other maxima that are nearly as high, each once, best first."""
    known = [peak.point]
    # Distances count along the directions with curvature alone.
    directions = np.column_stack([peak.basis, *(lost.direction for lost in peak.lost)])
    pseudo_inverse = np.linalg.pinv(directions)[: peak.basis.shape[1]]
    for value, point in sorted(found, key=lambda one: -one[0]):
        distances = np.linalg.norm((np.array(known) - point) @ pseudo_inverse.T, axis=1)
        if value > peak.value - RIVAL_NATS and distances.min() > RIVAL_DISTANCE:
            known.append(point)
            yield point, value


def population_scale(x: Array) -> Array:
    """Lower Cholesky factor of the covariance of points (m, k), regular even if m < k."""
    covariance = np.cov(x, rowvar=False).reshape(x.shape[1], -1)
    variance = np.maximum(np.diag(covariance), 1e-12)
    return np.linalg.cholesky(covariance + 1e-6 * np.diag(variance))


def rescaled(
    scale: Array, curvature: Array, directions: Array, spread: Array, longest: float = MAX_LENGTH
) -> Array:
    """Columns along the directions of curvature, one standard error long, within limits.

    ``longest`` is in standard deviations of the population.
    """
    scale = scale @ directions / np.sqrt(np.clip(np.abs(curvature), *RESCALING))
    length = np.linalg.norm(np.linalg.solve(spread, scale), axis=0)
    return scale * np.minimum(1.0, longest / length)


def _starts(population: Population, spread: Array) -> Array:
    """The best point of the population, and the best of those far from all taken before."""
    z = population.x @ np.linalg.inv(spread).T
    far = np.median(cdist(z, z))
    free = np.isfinite(population.log_ratio)
    taken: list[int] = []
    while free.any() and len(taken) < N_STARTS:
        best = int(np.where(free, population.log_ratio, -np.inf).argmax())
        taken.append(best)
        free &= np.linalg.norm(z - z[best], axis=1) > far
    return population.x[taken]


def _fitting(function: BatchFunction, point: Array, scale: Array) -> Array:
    """Shorten every column of a scale until the function changes little along it, both ways."""
    k, r = scale.shape
    moves = (LENGTHS[:, None, None] * scale.T).reshape(-1, k)
    values = function(np.concatenate([point[None], point + moves, point - moves]))
    change = np.abs(values[1:] - values[0]).reshape(2, len(LENGTHS), r).max(axis=0)
    fits = np.logical_and.accumulate((change <= MAX_CHANGE)[::-1])[::-1]
    longest = np.where(fits.any(axis=0), fits.argmax(axis=0), len(LENGTHS) - 1)
    return scale * LENGTHS[longest]


def _peak(function: BatchFunction, point: Array, spread: Array) -> Peak:
    """Refine a maximum, and find the directions along which it has no curvature.

    Where the function levels off towards a bound, the maximum is moved on as long as that gains.
    """
    for _ in range(N_MOVES):
        local, edges = _refined_inside(function, point, spread)
        lost, point, gain = _without_curvature(function, local)
        if gain < MIN_GAIN:
            break
    curvature, directions = local.spectrum()
    kept = [i for i in range(len(curvature)) if i not in lost]
    basis = local.scale @ directions[:, kept] / np.sqrt(curvature[kept])
    return Peak(
        local.point,
        local.value,
        0.0,
        basis,
        (*edges, *lost.values()),
        unconstrained_hessian(local.scale, local.hessian),
        np.zeros((len(point), len(point))),
        tuple(_doubts(local, curvature[kept], directions[:, kept])),
    )


def _refined_inside(
    function: BatchFunction, point: Array, spread: Array
) -> tuple[_Local, tuple[Lost, ...]]:
    """Refine a maximum; parameters at the edge of the support are held there, and lost."""
    try:
        return _refined(function, point, _fitting(function, point, spread), spread), ()
    except EdgeError:
        axes = _fitting(function, point, np.diag(np.linalg.norm(spread, axis=1)))
    around = function(np.concatenate([point + axes, point - axes]))
    at_edge = ~np.isfinite(around).reshape(2, len(point)).all(axis=0)
    try:
        local = _refined(function, point, axes[:, ~at_edge], spread)
    except EdgeError:
        at_edge[:] = True
        local = _derivatives_at(function, point, axes[:, ~at_edge])
    return local, tuple(Lost(axis, EDGE) for axis in axes[at_edge])


def _refined(function: BatchFunction, point: Array, scale: Array, spread: Array) -> _Local:
    """Newton steps from a point near the maximum, in scales of one standard error.

    Raises `EdgeError` if the function is -inf within the differences.
    """
    local = _derivatives_at(function, point, scale)
    for i in range(N_REFINED):
        curvature, directions = local.spectrum()
        newton = directions.T @ local.gradient / np.clip(np.abs(curvature), *RESCALING)
        sure = np.where(curvature > MIN_CURVATURE, newton, 0.0)
        if i >= N_RESCALED and np.linalg.norm(sure) < SETTLED:
            break
        steps = np.stack([np.zeros_like(sure), *map(_shortened, (newton, sure))])
        points = local.point + steps @ directions.T @ local.scale.T
        values = function(points)
        # the steps of the last digits change the value by rounding errors alone
        values[0] -= 1e-12 * abs(values[0])
        scale = local.scale
        if i < N_RESCALED:
            scale = rescaled(scale, curvature, directions, spread)
        local = _derivatives_at(function, points[values.argmax()], scale)
    return local


def _shortened(step: Array) -> Array:
    return step / max(1.0, float(np.linalg.norm(step)))


def _derivatives_at(function: BatchFunction, point: Array, scale: Array) -> _Local:
    """Derivatives by differences with two steps, extrapolated to fourth order."""
    value = float(function(point[None])[0])
    scaled, origin = along(function, point, scale), np.zeros(scale.shape[1])
    (fine_g, fine), (coarse_g, coarse) = (derivatives(scaled, origin, h) for h in (STEP, 2 * STEP))
    gradient, hessian = (4 * fine_g - coarse_g) / 3, (4 * fine - coarse) / 3
    ruggedness = float(np.abs(coarse - fine).max(initial=0.0))
    return _Local(point, value, scale, gradient, hessian, ruggedness)


def _without_curvature(
    function: BatchFunction, local: _Local
) -> tuple[dict[int, Lost], Array, float]:
    """The directions along which the function does not fall, by their numbers.

    Also the best point met on the way, and its gain.
    """
    curvature, directions = local.spectrum()
    lost, best, gain = {}, local.point, 0.0
    for i in np.flatnonzero(curvature < MIN_CURVATURE):
        direction = local.scale @ directions[:, i]
        probes = local.point + np.multiply.outer((*PROBES, *(-t for t in PROBES)), direction)
        gains = _trusted_gains(function, local, probes.reshape(2, len(PROBES), -1)).ravel()
        level = (gains > -MIN_FALL).reshape(2, -1).all(axis=1).any()
        if gains.max() > MIN_FALL or curvature[i] <= -MIN_CURVATURE:
            lost[int(i)] = Lost(direction, INCREASING)
        elif level or curvature[i] <= 0:
            lost[int(i)] = Lost(direction, LEVEL)
        if gains.max() > gain:
            best, gain = probes[gains.argmax()], float(gains.max())
    return lost, best, gain


def _trusted_gains(function: BatchFunction, local: _Local, probes: Array) -> Array:
    """Gains (2, m) at probes (2, m, k) on two rays; 0 from where rounding errors are as large.

    Far out a likelihood may lose its digits: that of counts, whose overdispersion vanishes.
    """
    twins = probes[..., None, :] + TWIN * np.multiply.outer(range(N_TWINS), local.scale.sum(axis=1))
    values = function(twins.reshape(-1, len(local.point))).reshape(twins.shape[:-1])
    gains = values[..., 0] - local.value
    with np.errstate(invalid="ignore"):  # where no twin has a density there is no rounding
        rounding = np.ptp(values, axis=-1)
    is_blurred = (rounding > ROUNDING) & (np.abs(gains) < TRUSTED * rounding)
    return np.where(np.logical_or.accumulate(is_blurred, axis=1), 0.0, gains)


def _doubts(local: _Local, curvature: Array, directions: Array) -> list[str]:
    doubts = []
    remaining = float(np.linalg.norm(directions.T @ local.gradient / np.sqrt(curvature)))
    if remaining > MAX_DECREMENT:
        doubts.append(
            f"the search did not converge: a Newton step of {remaining:.2g} standard errors remains"
        )
    if local.ruggedness > MAX_RUGGEDNESS:
        doubts.append(
            "the standard errors are inaccurate: the curvature depends on the step of the "
            f"differences, by {local.ruggedness:.0%} for a step of {2 * STEP} standard errors"
        )
    return doubts
