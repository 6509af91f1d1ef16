"""Lengths along the axes over which a log-density hardly changes: its scale at a point."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def axis_lengths(
    log_density: Callable[[Array], Array],
    point: Array,
    largest: Array,
    n_quarterings: int,
    most_change: float,
) -> tuple[float, Array]:
    """The log-density at a point (k,), and the longest moves (k,) along axes that hardly change it.

    By at most so many nats, both ways, as all shorter moves do; of the ``largest`` (k,), their
    quarters, and so on. Where none does, the shortest.
    """
    lengths = np.multiply.outer(4.0 ** -np.arange(n_quarterings), largest)
    moves = (lengths[:, :, np.newaxis] * np.eye(point.size)).reshape(-1, point.size)
    here, *around = log_density(np.concatenate([point[np.newaxis], point + moves, point - moves]))
    with np.errstate(invalid="ignore"):  # a density of zero at the point
        changes = np.abs(np.array(around) - here).reshape(2, *lengths.shape).max(axis=0)
    holds = np.logical_and.accumulate((changes <= most_change)[::-1], axis=0)
    return float(here), lengths[::-1][np.maximum(holds.sum(axis=0) - 1, 0), range(point.size)]
