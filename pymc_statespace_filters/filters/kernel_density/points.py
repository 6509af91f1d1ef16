"""Members and targets of a kernel density, of which each rank has a part."""

from typing import NamedTuple

import numpy as np

from pymc_statespace_filters.compiler.native.jit import inline_always
from pymc_statespace_filters.filters.ensemble.partition import MEMBERS, allgather


class Points(NamedTuple):
    """Members and their weights, or targets and the sums at them.

    The first ``size`` columns of ``rows`` (1 + n, width): first a row of the numbers, then rows of
    coordinates. Ranks have their `part` of the columns; ``known`` says whether all is known.
    """

    rows: np.ndarray
    size: int
    known: bool


@inline_always
def complete_points(layout, points, n_dims):
    """Let all ranks know numbers and coordinates of all points."""
    allgather(layout, points.rows[: 1 + n_dims], MEMBERS)
