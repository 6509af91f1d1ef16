"""Proposals in a tail of a posterior, beyond a value of one parameter.

The first ones extend the draws in the tail: the parameter has a generalised Pareto distribution
beyond its value there, and the others a Student distribution about their regression on it. The
weighted points then show where the tail lies, and a mixture of Student distributions is fitted to
them, in coordinates in which the distance from the tail's edge is logarithmic (Cappe, Guillin,
Marin and Robert 2004). This follows a tail that bends or narrows beyond the last draw, as the neck
of a funnel.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import genpareto

from ..importance import normalised, systematic
from ..student_mixture import StudentMixture, fit_mixture, place_components, standardised

SHAPE, WIDER = 0.25, 1.5  # of the Pareto distribution; of all scales, relative to the draws
N_COMPONENTS, N_FITTED = 8, 500  # of the mixture; weighted points and draws that it is fitted to
DEFENCE = 0.2  # share of the first proposals among later ones
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

    def to_log(self, x: Array) -> Array:
        """Points x (m, k) with the logarithm of the distance in place of the parameter."""
        y = x.copy()
        y[:, self.parameter] = np.log(np.maximum(self.distance(x), np.finfo(float).tiny))
        return y

    def from_log(self, y: Array) -> Array:
        """The points x (m, k) of those of `to_log`."""
        x = y.copy()
        x[:, self.parameter] = self.side * (self.edge + np.exp(y[:, self.parameter]))
        return x


class Extension:
    """The first proposals, fitted to the draws x (n, k) in a tail."""

    def __init__(self, tail: Tail, x: Array) -> None:
        self._tail, distance = tail, tail.distance(x)
        self._furthest, self._scale = float(distance.max()), WIDER * float(distance.mean())
        others = np.delete(x, tail.parameter, axis=1)
        terms = np.column_stack([np.ones(len(x)), distance])
        self._line = np.linalg.lstsq(terms, others)[0]
        scatter = np.atleast_2d(np.cov(others - terms @ self._line, rowvar=False))
        k = others.shape[1]
        chol = np.linalg.cholesky(scatter) if k else np.empty((0, 0))
        self._about = StudentMixture(np.ones(1), np.zeros((1, k)), WIDER * chol[None])

    def _centre(self, distance: Array) -> Array:
        """The regression, level beyond the last draw."""
        return self._line[0] + np.minimum(distance, self._furthest)[:, None] * self._line[1]

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Independent points (count, k)."""
        distance = genpareto.rvs(SHAPE, scale=self._scale, size=count, random_state=rng)
        others = self._centre(distance) + self._about.sample(count, rng)
        value = self._tail.side * (self._tail.edge + distance)
        return np.insert(others, self._tail.parameter, value, axis=1)

    def log_density(self, x: Array) -> Array:
        """Log-density at points x (m, k), shape (m,)."""
        distance = self._tail.distance(x)
        others = np.delete(x, self._tail.parameter, axis=1)
        log_pareto = genpareto.logpdf(distance, SHAPE, scale=self._scale)
        if not others.shape[1]:
            return np.asarray(log_pareto)
        return log_pareto + self._about.log_density(others - self._centre(distance))


class Refined:
    """Proposals of a mixture fitted to weighted points of a tail, and a share of the first ones."""

    def __init__(self, tail: Tail, first: Extension, x: Array, rng: np.random.Generator) -> None:
        self._tail, self._first = tail, first
        fitted = standardised(tail.to_log(x))
        if fitted is None:
            raise np.linalg.LinAlgError("points that do not vary in every direction")
        mixture = fit_mixture(fitted.z, place_components(fitted.z, N_COMPONENTS, rng))
        self._mixture = mixture.affine(fitted.mean, fitted.chol)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Independent points (count, k), the share of the first ones exact."""
        n_first = int(DEFENCE * count)
        new = self._tail.from_log(self._mixture.sample(count - n_first, rng))
        return np.concatenate([new, self._first.sample(n_first, rng)])

    def log_density(self, x: Array) -> Array:
        """Log-density at points x (m, k), shape (m,)."""
        y = self._tail.to_log(x)
        new = self._mixture.log_density(y) - y[:, self._tail.parameter]
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
