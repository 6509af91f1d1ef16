"""A first proposal covariance where the user has chosen the start: the scale of the density there.

The prior may be a million times wider, and a chain at the maximum would then accept nothing.
"""

import numpy as np
from numpy.typing import NDArray

from ...statistics.axis_lengths import axis_lengths
from ..target.target import Target

_N_QUARTERINGS = 20  # of the lengths tried along each axis, from those of the prior on
_MOST_CHANGE = 2.0  # nats, up to a length and at all shorter ones

Array = NDArray[np.float64]


def local_cov(target: Target, point: Array) -> Array | None:
    """A diagonal covariance (d, d) of lengths along the axes that hardly change the log-density.

    None for expensive or noisy filters, or if the density at the point (d,) is zero.
    """
    if target.is_expensive:
        return None
    rows, largest = target.density.at_rows(), np.sqrt(target.prior_draws.variances())
    try:
        here, longest = axis_lengths(
            lambda x: rows(x)[0], point, largest, _N_QUARTERINGS, _MOST_CHANGE
        )
    except Exception as error:
        error.add_note("around the start of a chain, after 0 iterations")
        raise
    if not np.isfinite(here):
        return None
    return np.asarray(np.diag(longest**2) * 2.38**2 / point.size)
