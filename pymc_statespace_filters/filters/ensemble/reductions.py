"""Sums, means and covariances over the members of all ranks, and which of them this rank holds.

Members belong to ranks in whole blocks of 64. A sum is a row of an array with a column for each
block. Every rank writes the columns of its local blocks, one allgather fills in the others, and
every rank adds up all of them in their order. The sum over one block is made by the same
instructions on every rank, so that the result is bit for bit the same on any number of ranks. With
one rank nothing is exchanged.
"""

from typing import NamedTuple

import numpy as np

from ...compiler.native.entry_point import call_address
from ...compiler.native.jit import inline_always, njit_internal, njit_reassoc, njit_strict
from ...compiler.numerics.normals import BLOCK

MEMBERS, BLOCKS = np.int64(BLOCK), np.int64(1)
"""Columns of a block: an array has a column for each member, or one for each block.

With one column a block, an array may also be any list whose columns are dealt out evenly.
"""


class RankLayout(NamedTuple):
    """A rank, the number of ranks, and the address of their exchange, 0 where there is one rank.

    An exchange takes the address of an array, its rows, its columns, and the columns of a block.
    """

    rank: int
    n_ranks: int
    exchange: int


@inline_always
def local_range(layout, n_columns, per_block):
    """First and last (exclusive) of the columns that are our own."""
    n_blocks = -(-n_columns // per_block)
    first = per_block * (n_blocks * layout.rank // layout.n_ranks)
    last = per_block * (n_blocks * (layout.rank + 1) // layout.n_ranks)
    return np.int64(min(first, n_columns)), np.int64(min(last, n_columns))


@njit_internal
def allgather(layout, array, per_block):
    """Fill the columns of a contiguous array (rows, columns) that are not our own."""
    if layout.exchange != 0:
        rows, columns = np.int64(array.shape[0]), np.int64(array.shape[1])
        call_address(layout.exchange, (array, rows, columns, per_block))


HALVES = (32, 16, 8, 4, 2, 1)
"""The halves of a block, then of its first half, and so on."""

FIRST_ROW = np.int64(0)
"""The first row of sums; numba would compile a function once more for a literal 0."""


class LocalPartition(NamedTuple):
    """The members of this rank among those of all ranks, and scratch of sums over members.

    There are ``size`` of them, padded to whole blocks ``width``, from member ``first`` and block
    ``first_block`` on. ``sums`` is (rows, blocks of all members), ``lanes`` has a number for each
    member of a block.
    """

    layout: RankLayout
    n_members: int
    first: int
    size: int
    width: int
    first_block: int
    sums: np.ndarray
    lanes: np.ndarray


@njit_internal
def local_partition(layout, n_members, n_rows):
    """The members of this rank, with room for ``n_rows`` rows of sums."""
    first, last = local_range(layout, n_members, MEMBERS)
    width = BLOCK * -(-(last - first) // BLOCK)
    sums = np.empty((n_rows, -(-n_members // BLOCK)))
    lanes = np.empty(BLOCK)
    return LocalPartition(
        layout, n_members, first, last - first, width, first // BLOCK, sums, lanes
    )


@njit_internal
def allgather_sums(local, n_rows):
    """Fill in the blocks of other ranks in the first rows of sums."""
    allgather(local.layout, local.sums[:n_rows], BLOCKS)


@njit_reassoc
def total(local, row):
    """Add up a completed row."""
    sums, result = local.sums[row], 0.0
    for block in range(sums.size):
        result += sums[block]
    return result


def _by_blocks(term):
    """The function (given, n, out) that writes the sum of ``term(given, i)`` of each block.

    In an order that is written down, and without leave to rearrange: what the compiler makes of a
    block must not depend on how many follow it.
    """

    @njit_strict
    def write_sums(given, n, out):
        lanes = np.empty(BLOCK)
        for first in range(0, n, BLOCK):
            count = min(BLOCK, n - first)
            for i in range(count):
                lanes[i] = term(given, first + i)
            for i in range(count, BLOCK):
                lanes[i] = 0.0
            for half in HALVES:
                for i in range(half):
                    lanes[i] += lanes[half + i]
            out[first // BLOCK] = lanes[0]

    return write_sums


@_by_blocks
@njit_strict
def _values(values, i):
    return values[i]


@_by_blocks
@njit_strict
def _squares(values, i):
    return values[i] * values[i]


@_by_blocks
@njit_strict
def _spread(w, i):
    return w[i] * (1.0 - w[i])


@_by_blocks
@njit_strict
def _weighted(given, i):
    w, x = given
    term = w[i] * x[i]
    return term if w[i] > 0.0 else 0.0


@_by_blocks
@njit_strict
def _products(given, i):
    w, x, x_mean, y, y_mean = given
    term = w[i] * (x[i] - x_mean) * (y[i] - y_mean)
    return term if w[i] > 0.0 else 0.0


@njit_internal
def _local_blocks(local, row):
    return local.sums[row, local.first_block :]


@njit_internal
def sum_blocks(values, out):
    """Sum of every block of a vector."""
    _values(values, values.size, out)


@njit_internal
def sum_values(values, local, row):
    """Row of the sums of a vector, of numbers or flags."""
    _values(values, values.size, _local_blocks(local, row))


@njit_internal
def sum_squares(values, local, row):
    """Row of the sums of the squares of a vector."""
    _squares(values, values.size, _local_blocks(local, row))


@njit_internal
def sum_spread(w, local, row):
    """Row of the sums of w (1 - w), all positive: in all 1 - sum w^2, if w is normalised."""
    _spread(w, w.size, _local_blocks(local, row))


@njit_internal
def sum_members(w, X, local, row):
    """Rows of sum_i w_i X_ai for each row of X; members of zero weight may be NaN."""
    for a in range(X.shape[0]):
        _weighted((w, X[a]), w.size, _local_blocks(local, row + a))


@njit_internal
def sum_products(w, X, x_mean, Y, y_mean, local, row):
    """Rows of sum_i w_i (X_ai - mean) (Y_bi - mean), b fastest; zero weight as above."""
    for a in range(X.shape[0]):
        for b in range(Y.shape[0]):
            out = _local_blocks(local, row + a * Y.shape[0] + b)
            _products((w, X[a], x_mean[a], Y[b], y_mean[b]), w.size, out)


@inline_always
def count(flags, local):
    """How many flags of all members are set."""
    sum_values(flags, local, FIRST_ROW)
    allgather_sums(local, FIRST_ROW + 1)
    return total(local, FIRST_ROW)


@njit_internal
def weighted_mean(w, X, total_weight, local, out):
    """Mean of each row of X; ``total_weight`` is the sum of w. Zero weights may have NaN."""
    sum_members(w, X, local, FIRST_ROW)
    allgather_sums(local, X.shape[0])
    for a in range(out.size):
        out[a] = total(local, a) / total_weight


# Not inlined: an entry point may multiply by a reciprocal, which changes the last bit.
@njit_internal
def weighted_cov(w, X, x_mean, Y, y_mean, divisor, local, out):
    """Covariances sum_i w_i (X_ai - mean) (Y_bi - mean) / divisor; zero weights as above."""
    n, p = out.shape
    sum_products(w, X, x_mean, Y, y_mean, local, FIRST_ROW)
    allgather_sums(local, n * p)
    for a in range(n):
        for b in range(p):
            out[a, b] = total(local, a * p + b) / divisor
