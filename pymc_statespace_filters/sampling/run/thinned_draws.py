"""Draws of which each is the last of several iterations, with the counts of all of them.

What is kept of an iteration is stored in the row of its draw, over what the iteration before has
left there; counts are added up. So chains may be cut anywhere, and coarsened at any time: a row is
the same, however its iterations came into it.
"""

from typing import NamedTuple

import numpy as np

from ..kernel.state import FAILURE, STAGE, Draws

# Columns of the counts that are codes: of the last iteration that has one.
_CODES = [STAGE, FAILURE]


class Thinning(NamedTuple):
    """Which iterations are kept: the first ``n_all``, and then the last of every ``every``."""

    n_all: int
    every: int = 1

    def rows(self, iterations: np.ndarray) -> np.ndarray:
        """The rows that iterations (n,), numbered from 0, belong to."""
        after = iterations - self.n_all
        return np.where(after < 0, iterations, self.n_all + after // self.every)

    def n_rows(self, n_iterations: int) -> int:
        """Number of rows that so many iterations have filled."""
        after = n_iterations - self.n_all
        return n_iterations if after < 0 else self.n_all + after // self.every

    def n_iterations(self, n_rows: int) -> int:
        """Number of iterations that fill so many rows."""
        after = n_rows - self.n_all
        return n_rows if after < 0 else self.n_all + after * self.every


def rows_of(draws: Draws, rows: slice, *, copy: bool = False) -> Draws:
    """Some rows of draws, without their covariances."""
    parts = {name: values[rows] for name, values in draws._asdict().items() if name != "covs"}
    if copy:
        parts = {name: values.copy() for name, values in parts.items()}
    return Draws(**parts, covs=draws.covs[:0])


def add_iterations(draws: Draws, rows: np.ndarray, iterations: Draws) -> None:
    """Add consecutive iterations to the rows (n,) that they belong to.

    The counts of rows to which nothing has been added are zero. Covariances are not added.
    """
    if not rows.size:
        return
    last = np.flatnonzero(np.diff(rows, append=-1))
    first, at = np.concatenate([[0], last[:-1] + 1]), rows[last]
    for name in ("positions", "numbers", "seeds"):
        getattr(draws, name)[at] = getattr(iterations, name)[last]
    codes = draws.counts[np.ix_(at, _CODES)]
    draws.counts[at] += np.add.reduceat(iterations.counts, first, axis=0)
    found = iterations.counts[:, _CODES]
    index = np.where(found != 0, np.arange(len(rows))[:, None], -1)
    newest = np.maximum.reduceat(index, first, axis=0)
    newer = np.take_along_axis(found, np.maximum(newest, 0), axis=0)
    draws.counts[np.ix_(at, _CODES)] = np.where(newest >= 0, newer, codes)


def coarsen(draws: Draws, n_rows: int, before: Thinning, after: Thinning) -> None:
    """Rearrange the first rows of draws, kept so far by one rule, to be kept by a coarser one."""
    rows = np.arange(before.n_all, n_rows)
    if not rows.size:
        return
    old = rows_of(draws, slice(before.n_all, n_rows), copy=True)
    draws.counts[before.n_all : n_rows] = 0
    firsts = before.n_all + (rows - before.n_all) * before.every
    add_iterations(draws, after.rows(firsts), old)
