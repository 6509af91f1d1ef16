"""Proposals in a tail of a posterior, beyond a value of one parameter.

They are made in coordinates in which the tail is as straight as the points in it tell: the
logarithm of the distance from its edge, and the other parameters less their regression on the
distance, in directions in which their standard deviation changes exponentially with it, as in the
neck of a funnel. The first proposals extend the draws in the tail: the distance has a generalised
Pareto distribution, and the others a Student distribution. The weighted points then show where the
tail lies, and coordinates and a mixture of Student distributions are fitted to them (Cappe,
Guillin, Marin and Robert 2004). This follows a tail beyond the last draw.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from ...statistics.importance import normalised, systematic
from ...statistics.student_mixture import (
    StudentMixture,
    fit_mixture,
    place_components,
    standardised,
)

SHAPE, WIDER = 0.25, 1.5  # of the Pareto distribution; of all scales, relative to the draws
N_COMPONENTS, N_FITTED = 8, 500  # of the mixture; weighted points and draws that it is fitted to
DEFENCE = 0.2  # share of the first proposals among later ones
MOST_CHANGE = 100.0  # of a variance, from the near to the far half of a tail
SIZES = (500, 2000, 2000, 2000, 16_000)  # points of each fit

Array = NDArray[np.float64]
Evaluate = Callable[[Array, np.random.Generator], Array]


class Tail(NamedTuple):
    """Where a parameter lies beyond a value: ``side * x[:, parameter] > edge``."""

    parameter: int
    side: int
    edge: float

    def distance(self, x: Array) -> Array:
        """Distances beyond the edge of points x (..., k); negative outside."""
        return self.side * x[..., self.parameter] - self.edge


class Straightened:
    """Coordinates of a tail, fitted to points x (n, k) in it.

    The first is the logarithm of the distance. The others have a standard deviation of about one,
    and none depends on the distance. Beyond the furthest point, regression and scales are level.
    """

    def __init__(self, tail: Tail, x: Array) -> None:
        self._tail, distance = tail, tail.distance(x)
        self._furthest = float(distance.max())
        others = np.delete(x, tail.parameter, axis=1)
        self._line = np.linalg.lstsq(np.column_stack([np.ones(len(x)), distance]), others)[0]
        is_far = distance > np.median(distance)
        self._near = float(distance[~is_far].mean())
        k, apart = others.shape[1], float(distance[is_far].mean()) - self._near
        residuals = others - self._centre(distance)
        self._rates, self._directions = np.empty(k), np.empty((k, k))
        if k:
            far, near = (
                np.atleast_2d(np.cov(residuals[of], rowvar=False)) for of in (is_far, ~is_far)
            )
            variances, self._directions = eigh(far, near)  # those of the near half are one
            variances = np.clip(variances, 1 / MOST_CHANGE, MOST_CHANGE)
            self._rates = 0.5 * np.log(variances) / apart
        self._log_det = float(np.linalg.slogdet(self._directions)[1])

    def _centre(self, distance: Array) -> Array:
        """The regression."""
        return self._line[0] + np.minimum(distance, self._furthest)[:, None] * self._line[1]

    def _log_scales(self, distance: Array) -> Array:
        return (np.minimum(distance, self._furthest) - self._near)[:, None] * self._rates

    def of(self, x: Array) -> tuple[Array, Array]:
        """Coordinates y (m, k) of points x (m, k), and log abs det dy/dx (m,)."""
        distance = np.maximum(self._tail.distance(x), np.finfo(float).tiny)
        log_scales, log_distance = self._log_scales(distance), np.log(distance)
        others = np.delete(x, self._tail.parameter, axis=1) - self._centre(distance)
        y = np.column_stack([log_distance, others @ self._directions * np.exp(-log_scales)])
        return y, self._log_det - log_scales.sum(axis=1) - log_distance

    def at(self, y: Array) -> Array:
        """The points x (m, k) of coordinates y (m, k)."""
        distance = np.exp(y[:, 0])
        scaled = y[:, 1:] * np.exp(self._log_scales(distance))
        others = self._centre(distance) + scaled @ np.linalg.inv(self._directions)
        value = self._tail.side * (self._tail.edge + distance)
        return np.insert(others, self._tail.parameter, value, axis=1)


class Extension:
    """The first proposals, fitted to the draws x (n, k) in a tail."""

    def __init__(self, tail: Tail, x: Array) -> None:
        self._coordinates = Straightened(tail, x)
        self._scale, k = WIDER * float(tail.distance(x).mean()), x.shape[1] - 1
        self._others = StudentMixture(np.ones(1), np.zeros((1, k)), WIDER * np.eye(k)[None])

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Independent points (count, k)."""
        distance = self._scale * np.expm1(SHAPE * rng.standard_exponential(count)) / SHAPE
        others = self._others.sample(count, rng)
        return self._coordinates.at(np.column_stack([np.log(distance), others]))

    def log_density(self, x: Array) -> Array:
        """Log-density at points x (m, k), shape (m,)."""
        y, log_det = self._coordinates.of(x)
        relative = np.exp(y[:, 0]) / self._scale
        log_pareto = np.log(relative) - (1 + 1 / SHAPE) * np.log1p(SHAPE * relative)
        of_others = self._others.log_density(y[:, 1:]) if x.shape[1] > 1 else 0.0
        return np.asarray(log_pareto + of_others + log_det)


class Refined:
    """Proposals of a mixture fitted to weighted points of a tail, and a share of the first ones."""

    def __init__(self, tail: Tail, first: Extension, x: Array, rng: np.random.Generator) -> None:
        self._coordinates, self._first = Straightened(tail, x), first
        fitted = standardised(self._coordinates.of(x)[0])
        if fitted is None:
            raise np.linalg.LinAlgError("points that do not vary in every direction")
        mixture = fit_mixture(fitted.z, place_components(fitted.z, N_COMPONENTS, rng))
        self._mixture = mixture.affine(fitted.mean, fitted.chol)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Independent points (count, k), the share of the first ones exact."""
        n_first = int(DEFENCE * count)
        new = self._coordinates.at(self._mixture.sample(count - n_first, rng))
        return np.concatenate([new, self._first.sample(n_first, rng)])

    def log_density(self, x: Array) -> Array:
        """Log-density at points x (m, k), shape (m,)."""
        y, log_det = self._coordinates.of(x)
        new = self._mixture.log_density(y) + log_det
        return np.logaddexp(np.log1p(-DEFENCE) + new, np.log(DEFENCE) + self._first.log_density(x))


class WeightedPoints(NamedTuple):
    """Points x (m, k) in a tail; the mean of their weights is the evidence of the tail."""

    x: Array
    log_weights: Array  # (m,)


def weighted_points(
    tail: Tail, draws: Array, evaluate: Evaluate, share: float, rng: np.random.Generator
) -> WeightedPoints:
    """Independent points in a tail, of the last of several fits.

    ``draws`` (n, k) are those in it, ``share`` that of `SIZES` which is evaluated.
    """
    sizes = [max(N_FITTED, int(share * size)) for size in SIZES]
    q: Extension | Refined
    q = first = Extension(tail, draws)
    chosen = draws[np.linspace(0, len(draws) - 1, min(N_FITTED, len(draws))).astype(int)]
    x, log_weights = _weighted(q, sizes[0], evaluate, rng)
    for size in sizes[1:]:
        if np.isneginf(log_weights).all():
            break
        kept = x[systematic(normalised(log_weights), N_FITTED, rng)]
        q = Refined(tail, first, np.concatenate([kept, chosen]), rng)
        x, log_weights = _weighted(q, size, evaluate, rng)
    return WeightedPoints(x, log_weights)


def _weighted(
    q: Extension | Refined, count: int, evaluate: Evaluate, rng: np.random.Generator
) -> tuple[Array, Array]:
    x = q.sample(count, rng)
    return x, evaluate(x, rng) - q.log_density(x)
