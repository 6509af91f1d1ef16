"""The transition kernel of a step in tiles of eight points, for steps that are all the same.

A *tile* holds the factors of one column for a block of eight rows, so that a block of results is a
sum of columns times numbers, in SIMD vectors without horizontal sums. Rows are targets for the
prediction, and sources for its adjoint. Block ``b`` holds the points ``8 b .. 8 b + 7``. The tiles
of successive columns of a block are a *run*. The sums are written in LLVM vectors, because the
compiler would keep a block in memory.
"""

import math
from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ...compiler.native.jit import njit_internal
from .grid import add_gaussian

LANES = 8
_SUMS = 4  # side by side, as one addition waits for the one before
_DOUBLE, _INT32, _INT64 = ir.DoubleType(), ir.IntType(32), ir.IntType(64)
_VECTOR = ir.VectorType(_DOUBLE, LANES)


class Tiles(NamedTuple):
    """Runs of tiles, sorted by block: run r has the columns from ``start[r]`` on.

    Its tiles are those from ``at[r]`` to ``at[r + 1]``; the factors of tile i begin at 8 i. Rows or
    columns that are targets cover the blocks ``low .. high - 1``.
    """

    block: np.ndarray
    start: np.ndarray
    at: np.ndarray
    factors: np.ndarray
    low: int
    high: int


@njit_internal
def no_tiles(low, high):
    """Tiles of no source."""
    indices = np.empty(0, np.int64)
    return Tiles(indices, indices, indices, np.empty(0), low, high)


@njit_internal
def block_of(point):
    """The block of a point."""
    return point >> 3


@njit_internal
def _blocks_of(mean, sd, spacing, reach, low, high):
    """The blocks [first, end) of [low, high) that are within ``reach`` of each source."""
    first, end = np.zeros(mean.size, np.int64), np.zeros(mean.size, np.int64)
    for i in range(mean.size):
        begin = math.floor((mean[i] - reach * sd[i]) / (spacing * LANES))
        stop = math.floor((mean[i] + reach * sd[i]) / (spacing * LANES)) + 1.0
        is_regular = sd[i] > 0.0 and np.isfinite(mean[i]) and np.isfinite(sd[i])
        if is_regular and begin < high and stop > low:
            first[i], end[i] = np.int64(max(begin, float(low))), np.int64(min(stop, float(high)))
    return first, end


@njit_internal
def tiles_to_targets(source, spacing, mean, sd, reach, low, high):
    """Tiles whose rows are the targets in blocks [low, high).

    Their columns are the points from ``source`` on, from which mean and sd are given.
    """
    first, end = _blocks_of(mean, sd, spacing, reach, low, high)
    ends = np.zeros(high - low + 1, np.int64)
    n_runs = 0
    for i in range(mean.size):
        for b in range(first[i], end[i]):
            ends[b - low + 1] += 1
            follows = i > 0 and first[i - 1] <= b < end[i - 1]
            n_runs += 0 if follows else 1
    for b in range(high - low):
        ends[b + 1] += ends[b]
    column, factors = np.empty(ends[-1], np.int64), np.zeros(LANES * ends[-1])
    next_tile = ends[:-1].copy()
    for i in range(mean.size):
        for b in range(first[i], end[i]):
            tile = next_tile[b - low]
            next_tile[b - low] += 1
            column[tile] = source + i
            points = factors[LANES * tile : LANES * (tile + 1)]
            add_gaussian(float(LANES * b), spacing, mean[i], sd[i], 1.0, points)
    block, start = np.empty(n_runs, np.int64), np.empty(n_runs, np.int64)
    at, run = np.empty(n_runs + 1, np.int64), 0
    for b in range(high - low):
        for tile in range(ends[b], ends[b + 1]):
            if tile == ends[b] or column[tile] != column[tile - 1] + 1:
                block[run], start[run], at[run] = low + b, column[tile], tile
                run += 1
    at[run] = column.size
    return Tiles(block, start, at, factors, low, high)


@njit_internal
def tiles_to_sources(source, spacing, mean, sd, reach, low, high):
    """The transpose: rows from point ``source``, a multiple of 8, and columns in [low, high)."""
    first, end = _blocks_of(mean, sd, spacing, reach, low, high)
    n_runs = mean.size // LANES
    block, start = np.empty(n_runs, np.int64), np.empty(n_runs, np.int64)
    at = np.zeros(n_runs + 1, np.int64)
    for r in range(n_runs):
        lowest, highest = high, low
        for i in range(LANES * r, LANES * (r + 1)):
            if first[i] < end[i]:
                lowest, highest = min(lowest, first[i]), max(highest, end[i])
        block[r], start[r] = block_of(source) + r, LANES * lowest
        at[r + 1] = at[r] + LANES * max(highest - lowest, 0)
    factors, row = np.zeros(LANES * at[n_runs]), np.empty(0)
    for i in range(mean.size):
        r = i // LANES
        row = np.zeros(LANES * (end[i] - first[i]))
        add_gaussian(float(LANES * first[i]), spacing, mean[i], sd[i], 1.0, row)
        tile = at[r] + LANES * first[i] - start[r]
        for b in range(row.size):
            factors[LANES * (tile + b) + i % LANES] = row[b]
    return Tiles(block, start, at, factors, low, high)


@intrinsic
def _add_columns(typing, factors, at, values, start, n, out, to):
    """Add to eight points of ``out`` from ``to`` on: sum_b values[start + b] * tile at + b."""

    def generate(context, b, signature, arguments):
        arrays = [
            context.make_array(signature.args[i])(context, b, arguments[i]).data for i in (0, 2, 5)
        ]
        tiles, numbers, results = arrays
        at, start, n, to = (arguments[i] for i in (1, 3, 4, 6))
        zero = ir.Constant(_VECTOR, [0.0] * LANES)
        sums = [cgutils.alloca_once_value(b, zero) for _ in range(_SUMS)]
        lanes = ir.Constant(ir.VectorType(_INT32, LANES), [0] * LANES)

        def load(array, point):
            return b.load(b.bitcast(b.gep(array, [point]), _VECTOR.as_pointer()), align=8)

        def add(total, column):
            number = b.load(b.gep(numbers, [b.add(start, column)]))
            first = b.insert_element(ir.Constant(_VECTOR, ir.Undefined), number, _INT32(0))
            tile = load(tiles, b.mul(_INT64(LANES), b.add(at, column)))
            product = b.fmul(b.shuffle_vector(first, first, lanes), tile, flags=("contract",))
            b.store(b.fadd(b.load(total), product, flags=("contract",)), total)

        whole = b.sdiv(n, _INT64(_SUMS))
        with cgutils.for_range(b, whole) as loop:
            for i, total in enumerate(sums):
                add(total, b.add(b.mul(loop.index, _INT64(_SUMS)), _INT64(i)))
        with cgutils.for_range_slice(b, b.mul(whole, _INT64(_SUMS)), n, _INT64(1)) as (column, _):
            add(sums[0], column)
        result = load(results, to)
        for total in sums:
            result = b.fadd(result, b.load(total))
        address = b.bitcast(b.gep(results, [to]), _VECTOR.as_pointer())
        b.store(result, address, align=8)
        return context.get_dummy_value()

    integer = types.int64
    return types.void(factors, integer, values, integer, integer, out, integer), generate


@njit_internal
def multiply(tiles, low, values, first_block, n_blocks):
    """Sums over columns of factors times ``values``, which begin at column ``low``.

    The result has the rows of ``n_blocks`` blocks from ``first_block`` on.
    """
    out = np.zeros(LANES * n_blocks)
    for r in range(tiles.block.size):
        b = tiles.block[r] - first_block
        begin, end = tiles.start[r], tiles.start[r] + tiles.at[r + 1] - tiles.at[r]
        first, stop = max(begin, low), min(end, low + values.size)
        if 0 <= b < n_blocks and first < stop:
            tile = tiles.at[r] + first - begin
            _add_columns(tiles.factors, tile, values, first - low, stop - first, out, LANES * b)
    return out
