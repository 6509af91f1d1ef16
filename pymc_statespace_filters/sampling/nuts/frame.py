"""Coordinates in which NUTS moves: those in which points of the posterior are round."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..starts.langevin import PER_DIMENSION, curvature_factor, metric_factor

Array = NDArray[np.float64]
WithGradient = Callable[[Array], tuple[float, Array]]

_MOST_POINTS = 512  # whose gradients are asked
# Points per dimension; those of a walk in more than 128 dimensions depend on each other.
_ENOUGH = 4
# Points where curvature is asked. That at their mean alone may be a hundredth of what it is at
# some of them, where a step that suits it diverges.
_N_CURVED = 8


class Frame(NamedTuple):
    """Coordinates z of positions x = centre + factor z.

    nutpie takes no mass matrix. In these coordinates it is the identity where its warm-up begins,
    and what the search for starts has learnt is not learnt again, in long trajectories.
    """

    centre: Array  # (d,)
    factor: Array  # (d, d), lower triangular
    is_whole: bool = False  # whether correlations are in it

    @property
    def adaptation(self) -> str:
        """What nutpie is to learn: with correlations known, scales take fewer gradients."""
        return "diag" if self.is_whole else "low_rank"

    def positions(self, z: Array) -> Array:
        """Positions (..., d) of points in these coordinates."""
        return self.centre + z @ self.factor.T

    def coordinates(self, x: Array) -> Array:
        """The coordinates of one position (d,)."""
        return np.linalg.solve(self.factor, x - self.centre)

    def within(self, evaluate: WithGradient) -> WithGradient:
        """A log-density with its gradient, as functions of these coordinates."""

        def in_frame(z: Array) -> tuple[float, Array]:
            value, gradient = evaluate(self.positions(z))
            with np.errstate(invalid="ignore"):  # an infinite gradient, where the density is zero
                return value, gradient @ self.factor

        return in_frame


def frame_of(points: Array, evaluate: WithGradient, *, takes_curvature: bool) -> Frame:
    """The frame of points (m, d) of a posterior and their gradients, see `metric_factor`.

    Where the points are too few, that of the average curvature at some of them; without it, or
    where they do not vary in every direction, that of their deviations.
    """
    x = points[:: -(-len(points) // _MOST_POINTS)]

    def gradients(x: Array) -> Array:
        return np.array([evaluate(point)[1] for point in x])

    factor, d = None, x.shape[1]
    if takes_curvature and len(x) < _ENOUGH * d:
        factor = curvature_factor(x, gradients, x[:: -(-len(x) // _N_CURVED)])
    elif len(x) >= PER_DIMENSION * d:
        found = gradients(x)
        known = np.isfinite(found).all(axis=1)
        if known.sum() >= PER_DIMENSION * d:
            factor = metric_factor(x[known], found[known])
    if factor is not None:
        return Frame(points.mean(axis=0), factor, is_whole=True)
    sd = points.std(axis=0)
    return Frame(points.mean(axis=0), np.diag(np.where(sd > 0.0, sd, 1.0)))
