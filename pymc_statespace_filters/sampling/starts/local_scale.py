"""A first proposal covariance where the user has chosen the start: the scale of the density there.

The prior may be a million times wider, and a chain at the maximum would then accept nothing.
"""

import numpy as np
from numpy.typing import NDArray

from ..target.target import Target

_LENGTHS = 4.0 ** -np.arange(20.0)  # tried along each axis, relative to the prior
_MOST_CHANGE = 2.0  # nats, up to a length and at all shorter ones

Array = NDArray[np.float64]


def local_cov(target: Target, point: Array) -> Array | None:
    """A diagonal covariance (d, d) of lengths along the axes that hardly change the log-density.

    None for expensive or noisy filters, or if the density at the point (d,) is zero.
    """
    if target.is_expensive:
        return None
    dim = point.size
    lengths = np.multiply.outer(_LENGTHS, np.sqrt(target.prior_draws.variances()))
    offsets = (lengths[:, :, np.newaxis] * np.eye(dim)).reshape(-1, dim)
    points = np.concatenate([point[np.newaxis], point + offsets, point - offsets])
    try:
        here, *around = target.density.at_rows()(points)[0]
    except Exception as error:
        error.add_note("around the start of a chain, after 0 iterations")
        raise
    if not np.isfinite(here):
        return None
    changes = np.abs(np.array(around) - here).reshape(2, len(_LENGTHS), dim).max(axis=0)
    holds = np.logical_and.accumulate((changes <= _MOST_CHANGE)[::-1], axis=0)
    longest = lengths[::-1][np.maximum(holds.sum(axis=0) - 1, 0), range(dim)]
    return np.asarray(np.diag(longest**2) * 2.38**2 / dim)
