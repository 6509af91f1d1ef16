r"""Bring a population into equilibrium with a density that has a gradient, in many dimensions.

Random walks take some ten moves for each dimension to forget where a point was, so that a
population of twenty parameters ends its annealing a hundred nats below the posterior. Each point
here makes Metropolis-adjusted Langevin moves (Roberts and Tweedie 1996, Bernoulli 2, 341-363),

.. math::
    y = x + \tfrac{\epsilon^2}{2} S \nabla \log \pi(x) + \epsilon S^{1/2} z, \quad z \sim N(0, I),

with the metric of all points that minimises the Fisher divergence from a normal distribution
(Seyboldt, Carlson and Carpenter 2026, arXiv:2603.18845): the geometric mean of the covariance of
the points and the inverse of that of their gradients. For a normal posterior this is its
covariance, however the points are distributed, as long as they vary in every direction. For others
it is an average over typical points, unlike the curvature at a mode where a scale vanishes.

Where the points are too few for the number of parameters, the metric is the inverse of the
curvature of the log-density at their mean, with the absolute values of its eigenvalues.

The metric depends on the points that it moves, a bias that starts can bear.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...statistics.student_mixture import standardised

PER_DIMENSION = 3  # points at least, for the metric of points and gradients
_OFFSET = 1e-4  # for differences of gradients, in standard deviations of the points
_MOVES = 4  # of a round, between two looks at the log-density
_KEPT = 3  # last rounds, of which the points are returned
_MOST_ROUNDS = 40
_ACCEPTANCE = 0.55  # the best for Langevin moves (Roberts and Rosenthal 1998)
_STEPS = 0.05, 1.4  # bounds for epsilon; with the larger one the drift is a Newton step
_SETTLED = 0.1  # gain of a round in standard deviations of a normal posterior's log-density
_MOST_WIDER = 1e4  # the metric's variance along a direction, relative to that of the points

Array = NDArray[np.float64]
WithGradient = Callable[[Array], tuple[Array, Array]]


class _Cloud(NamedTuple):
    x: Array  # (m, k)
    log_density: Array  # (m,)
    gradient: Array  # (m, k)


def settle(x: Array, evaluate: WithGradient, rng: np.random.Generator) -> tuple[Array, Array]:
    """Move points (m, k) until their log-density no longer rises.

    ``evaluate`` gives log-densities (m,) and gradients (m, k). Gives the points after each of the
    last three rounds of moves (3 m, k), and their log-densities.
    """
    cloud, step, rounds = _Cloud(x, *evaluate(x)), 1.0, []
    is_few = len(x) < PER_DIMENSION * x.shape[1]
    threshold = _SETTLED * math.sqrt(x.shape[1] / 2)
    before = -np.inf
    for _ in range(_MOST_ROUNDS):
        total = 0.0
        curved = curvature_factor(cloud.x, lambda x: evaluate(x)[1]) if is_few else None
        for _ in range(_MOVES):
            chol = curved if is_few else _metric_of(cloud)
            cloud, rate = _moved(cloud, step, chol, evaluate, rng)
            step = float(np.clip(step * math.exp(rate - _ACCEPTANCE), *_STEPS))
            total += float(cloud.log_density.mean())
        rounds.append(cloud)
        if len(rounds) >= _KEPT and total / _MOVES < before + threshold:
            break
        before = total / _MOVES
    kept = rounds[-_KEPT:]
    return np.concatenate([c.x for c in kept]), np.concatenate([c.log_density for c in kept])


def metric_factor(x: Array, gradient: Array) -> Array | None:
    """Lower factor (k, k) of the metric, of points and gradients (m, k).

    None if the points do not vary in every direction.
    """
    points = standardised(x)
    if points is None:
        return None
    # In coordinates in which the points have the covariance one, the mean is a square root.
    cov = np.atleast_2d(np.cov(gradient @ points.chol, rowvar=False))
    variances, directions = np.linalg.eigh(cov)
    widths = np.maximum(variances, _MOST_WIDER**-2) ** -0.5
    return _lower(points.chol @ (directions * widths) @ directions.T @ points.chol.T)


def curvature_factor(
    x: Array, gradients: Callable[[Array], Array], at: Array | None = None
) -> Array | None:
    """Lower factor (k, k) of the inverse curvature at the mean of points (m, k).

    Or of the average curvature ``at`` some points (n, k), without those where it is not finite.
    ``gradients`` gives those of the log-density (n, k) at points (n, k). None if the curvature is
    finite nowhere, or if the points do not vary in a coordinate.
    """
    spread, k = x.std(axis=0), x.shape[1]
    at = x.mean(axis=0, keepdims=True) if at is None else at
    moves = np.diag(_OFFSET * spread)
    moved = np.stack([at[:, np.newaxis] + moves, at[:, np.newaxis] - moves])
    found = gradients(moved.reshape(-1, k)).reshape(moved.shape)
    found = found[:, np.isfinite(found).all(axis=(0, 2, 3))]
    if not (found.size and (spread > 0.0).all()):
        return None
    # In units of the spread.
    curvature = (found[0] - found[1]).mean(axis=0) * spread / (2 * _OFFSET)
    values, directions = np.linalg.eigh(0.5 * (curvature + curvature.T))
    widths = np.maximum(np.abs(values), 1 / _MOST_WIDER) ** -0.5
    half = spread[:, np.newaxis] * directions * widths
    return _lower(half @ half.T)


def _lower(metric: Array) -> Array | None:
    """The lower factor (k, k) of a metric; None if rounding has made it indefinite."""
    try:
        return np.linalg.cholesky(0.5 * (metric + metric.T))
    except np.linalg.LinAlgError:
        return None


def _metric_of(cloud: _Cloud) -> Array | None:
    known = np.isfinite(cloud.gradient).all(axis=1)
    return metric_factor(cloud.x[known], cloud.gradient[known])


def _moved(
    cloud: _Cloud,
    step: float,
    chol: Array | None,
    evaluate: WithGradient,
    rng: np.random.Generator,
) -> tuple[_Cloud, float]:
    """Move every point by a Langevin step, if there is a metric; also the acceptance rate."""
    if chol is None:
        return cloud, 0.0
    drift = 0.5 * step**2 * cloud.gradient @ chol
    noise = step * rng.standard_normal(cloud.x.shape)
    move = drift + noise
    x = cloud.x + move @ chol.T
    proposed = _Cloud(x, *evaluate(x))
    with np.errstate(invalid="ignore"):  # NaN is not accepted
        back = move + 0.5 * step**2 * proposed.gradient @ chol
        log_alpha = proposed.log_density - cloud.log_density
        log_alpha += ((noise**2).sum(axis=1) - (back**2).sum(axis=1)) / (2 * step**2)
        accepted = np.log(rng.random(len(x))) < log_alpha
    chosen = [
        np.where(accepted.reshape(-1, *[1] * (new.ndim - 1)), new, old)
        for new, old in zip(proposed, cloud, strict=True)
    ]
    return _Cloud(*chosen), float(accepted.mean())
