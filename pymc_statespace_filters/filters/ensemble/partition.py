"""Which members of an ensemble this process holds, and how it exchanges data with the others.

Members belong to ranks in whole blocks of 64. Sums over members are taken block by block, and then
over the blocks in their order, so that a sum is bit for bit the same on any number of ranks. Where
one process holds all members, nothing is exchanged.
"""

from typing import NamedTuple

import numpy as np

from ...compiler.native.entry_point import call_address
from ...compiler.native.jit import inline_always, njit_internal
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


SINGLE_RANK = (0, 1, 0)
"""A share of all members."""


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
