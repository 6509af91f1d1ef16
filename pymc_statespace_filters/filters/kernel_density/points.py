"""Members and targets of a kernel density, divided among ranks."""

from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import njit_internal
from ..ensemble.partition import MEMBERS, allgather


class Points(NamedTuple):
    """Members and their weights, or targets and the sums at them.

    In the first ``size`` columns of ``rows`` (1 + n, width) the first row holds the weights or
    sums, the others the coordinates. A rank fills the columns of its members; ``known`` is True if
    this rank holds all columns from the start.
    """

    rows: np.ndarray
    size: int
    known: bool


@njit_internal
def complete_points(layout, points, n_dims):
    """Complete the weights or sums and the coordinates on every rank."""
    allgather(layout, points.rows[: 1 + n_dims], MEMBERS)
