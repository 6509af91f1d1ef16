"""A maximum on the unconstrained space and the curvature there, as the searches return them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

LEVEL, INCREASING, EDGE, HIDDEN = "level", "increasing", "edge", "hidden"

Array = NDArray[np.float64]


class Lost(NamedTuple):
    """A direction along which the maximum has no curvature."""

    direction: Array  # (k,), some posterior standard deviations long
    kind: str  # LEVEL, INCREASING, EDGE (of the support) or HIDDEN (by noise)


class Peak(NamedTuple):
    """The largest log-likelihood found, its point, and the curvature there.

    The covariance of the estimate is ``basis @ basis.T``, without the lost directions.
    """

    point: Array  # (k,)
    value: float
    value_se: float
    basis: Array  # (k, r)
    lost: tuple[Lost, ...]
    hessian: Array  # (k, k); NaN for parameters at the edge of the support
    simulation_cov: Array  # (k, k), of the point, from the noise of the likelihood
    notes: tuple[str, ...]
    rivals: tuple[
        tuple[Array, float], ...
    ] = ()  # points and values of other, nearly as high maxima


def unconstrained_hessian(scale: Array, hessian: Array) -> Array:
    """Hessian (k, k) from that in coordinates z of x = scale z, scale (k, r).

    Rows of zeros in `scale` belong to parameters that were held; their second derivatives are NaN.
    """
    moved = scale.any(axis=1)
    found = np.full((len(scale), len(scale)), np.nan)
    if moved.any():
        inverse = np.linalg.inv(scale[moved])
        found[np.ix_(moved, moved)] = inverse.T @ hessian @ inverse
    return found
