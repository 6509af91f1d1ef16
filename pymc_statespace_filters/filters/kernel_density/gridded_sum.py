"""Sums of weighted Gaussian kernels at many targets through a uniform grid, O(N).

With s the variance of the spreading Gaussian (`simd_windows.VARIANCE`) and D the grid spacing, in
units of the kernel's standard deviation, and g and h running over the grid, in one direction

    exp(-(v - y)^2 / 2) ~ c sum_g sum_h exp(-(v - g)^2 / 2s) exp(-(g - h)^2 / 2(1 - 2s))
                            exp(-(h - y)^2 / 2s),    c = D^2 / (2 pi s sqrt(1 - 2s)).

So each member y adds its Gaussian to the grid, the grid is blurred (convolved with the middle
factor), and each target v sums the grid times its Gaussian. In two directions all three factors
are products over the directions.

As a function of g and h, the summand is the left side times a Gaussian density in which g and h
have variance s (1 - s). By Poisson's formula the relative error of the sums is therefore
4 exp(-2 pi^2 s (1 - s) / D^2) = 5e-10 for every single pair of member and target, however far
apart, and twice that in two directions: all terms are positive, nothing cancels. The truncation of
windows and blur is below 2e-15 of the total weight, so 2e-9 of a sum at the `FLOOR`. Smaller sums,
in the far tails, are left to the caller.

The members of a large ensemble are divided among several grids, which are then added in a fixed
order: the sums have the same bits on any number of ranks.
"""

import math

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.numerics.normals import BLOCK
from ...compiler.numerics.restricted_domain import exp
from ..ensemble.reductions import BLOCKS, MEMBERS, RankLayout, allgather, local_range
from .direct_sum import complete_points
from .simd_windows import (
    LANES,
    POINTS,
    REACH,
    SPACING,
    STEEPNESS,
    VARIANCE,
    add_to_line,
    add_to_plane,
    sum_line,
    sum_plane,
    taps_sum,
)

FLOOR = 1e-6
"""Sums below this fraction of the total weight are left to the caller."""

_NEGLIGIBLE = 1e-25  # smaller weights do not change sums above the floor, and make subnormals
_FAR = 8.6  # neither do members farther than this from all targets: exp(-FAR^2 / 2) < 1e-16
_BLUR = 16  # grid points on either side; an even number
_MEMBERS_PER_GRID = 8192  # larger ensembles are divided among several grids
_MOST_GRIDS = 8
_POINTS_PER_MEMBER = 4  # in all grids: clearing and adding them is then a fiftieth of the work
_BLUR_VARIANCE = 1.0 - 2.0 * VARIANCE
_blur_lanes = taps_sum(
    (SPACING**2 / (2.0 * math.pi * VARIANCE * math.sqrt(_BLUR_VARIANCE)))
    * np.exp(-((SPACING * np.arange(_BLUR + 1)) ** 2) / (2.0 * _BLUR_VARIANCE))
)
_POINTS_PER_UNIT = math.sqrt(2.0) / SPACING  # coordinates are scaled by 1 / sqrt(2)
_WITHIN = _FAR * math.sqrt(0.5)


@njit_internal
def gridded_sum_workspace(n_ranks, width):
    """Scratch of ``gridded_sums`` for a padded number of members.

    The windows of members or targets (first cell, lead and ratio, see `simd_windows`), lanes for a
    minimum and a maximum, the ranges found by each rank, first coordinate and extent of the grid,
    and two arrays for grids, several times as large as an ensemble of two states needs.
    """
    windows = np.empty((2, width)), np.empty((2, width)), np.empty((2, width))
    lanes, ranges = (np.empty(BLOCK), np.empty(BLOCK)), np.empty((8, n_ranks))
    room = 32768 + 8 * width
    return windows, lanes, ranges, (np.empty(2), np.empty(2)), (np.empty((1, room)), np.empty(room))


@njit_internal
def _range(y, w, least, lanes):
    """The smallest and the largest finite y of weights above ``least``."""
    low, high = lanes
    for i in range(BLOCK):
        low[i], high[i] = np.inf, -np.inf
    for first in range(0, w.size, BLOCK):
        count = min(BLOCK, w.size - first)
        y_block, w_block = y[first : first + count], w[first : first + count]
        for i in range(count):
            counted = (w_block[i] > least) & (abs(y_block[i]) < np.inf)
            low[i] = y_block[i] if counted & (y_block[i] < low[i]) else low[i]
            high[i] = y_block[i] if counted & (y_block[i] > high[i]) else high[i]
    for i in range(1, BLOCK):
        low[0] = low[i] if low[i] < low[0] else low[0]
        high[0] = high[i] if high[i] > high[0] else high[0]
    return low[0], high[0]


@njit_internal
def _find_ranges(layout, sources, targets, n_dims, lanes, ranges):
    """Ranges of members and of targets in each direction, of each rank.

    The sums at the targets must be zero: they serve as the weights of the targets.
    """
    y_first, y_last = local_range(layout, sources.size, MEMBERS)
    v_first, v_last = local_range(layout, targets.size, MEMBERS)
    w, zeros = sources.rows[0, y_first:y_last], targets.rows[0, v_first:v_last]
    for a in range(n_dims):
        y, v = sources.rows[1 + a, y_first:y_last], targets.rows[1 + a, v_first:v_last]
        found = ranges[4 * a : 4 * a + 4, layout.rank]
        found[0], found[1] = _range(y, w, _NEGLIGIBLE, lanes)
        found[2], found[3] = _range(v, zeros, -1.0, lanes)
    allgather(layout, ranges[: 4 * n_dims], BLOCKS)


@njit_internal
def _extent(ranges):
    """The first coordinate of the grid and its number of points.

    Members farther than ``_WITHIN`` from all targets are left out, as are targets that far from all
    members; the number of points is 0 if none remain.
    """
    y_low, y_high, v_low, v_high = ranges[0, 0], ranges[1, 0], ranges[2, 0], ranges[3, 0]
    for rank in range(1, ranges.shape[1]):
        y_low, y_high = min(y_low, ranges[0, rank]), max(y_high, ranges[1, rank])
        v_low, v_high = min(v_low, ranges[2, rank]), max(v_high, ranges[3, rank])
    first = max(min(y_low, v_low), max(y_low, v_low) - _WITHIN)
    last = min(max(y_high, v_high), min(y_high, v_high) + _WITHIN)
    if not first <= last:
        return first, 0.0
    steps = (last - first) * _POINTS_PER_UNIT
    return first, LANES * np.floor(steps / LANES + (1 + POINTS / LANES))


@njit_internal
def _place(y, first, n_points, cell, lead, ratio):
    """The windows at these coordinates: first cell, lead (zero outside the grid) and ratio."""
    last = n_points - POINTS
    for i in range(y.size):
        x = (y[i] - first) * _POINTS_PER_UNIT
        inside = (x >= 0.0) & (x < last + 1.0)
        x = x if inside else 0.0
        below = np.floor(x)
        r = x - below
        from_first = r + (REACH - 1.0)
        first_value = exp(-0.5 * STEEPNESS * from_first * from_first)
        cell[i] = below
        lead[i] = first_value if inside else 0.0
        ratio[i] = exp(STEEPNESS * (r - 1.0))


@njit_internal
def _weigh(w, lead):
    for i in range(w.size):
        lead[i] *= w[i] if w[i] > _NEGLIGIBLE else 0.0


@njit_internal
def _add_members(windows, n, n_dims, stride, grid):
    cell, lead, ratio = windows
    for i in range(n):
        if lead[0, i] > 0.0:
            at = _BLUR + np.int64(cell[0, i])
            if n_dims == 1:
                add_to_line(grid, at, stride, lead[0, i], ratio[0, i], 1.0, 0.0)
            else:
                at += stride * np.int64(cell[1, i])
                add_to_plane(grid, at, stride, lead[0, i], ratio[0, i], lead[1, i], ratio[1, i])


@njit_internal
def _number_of_grids(n_members, n_points):
    """Number of grids that the members are divided among: a power of two, as ranks often are."""
    n_grids = 1
    if n_members > _MEMBERS_PER_GRID:
        most = min(float(_MOST_GRIDS), _POINTS_PER_MEMBER * n_members / n_points)
        while 2 * n_grids <= most:
            n_grids *= 2
    return n_grids


@njit_internal
def _add_stretch(sources, i, j, n_dims, box, windows, grid):
    """Clear a grid and add the members i to j - 1 to it."""
    (first, extent), (cell, lead, ratio) = box, windows
    for point in range(grid.size):
        grid[point] = 0.0
    for a in range(n_dims):
        _place(sources.rows[1 + a, i:j], first[a], extent[a], cell[a], lead[a], ratio[a])
    _weigh(sources.rows[0, i:j], lead[0])
    _add_members(windows, j - i, n_dims, np.int64(extent[0]) + 2 * _BLUR, grid)


@njit_internal
def _add_all(layout, sources, n_dims, n_points, box, windows, grids):
    """The sum of the grids of all members, of n_points each.

    Members are divided among grids as they are among ranks. If every rank has the same number of
    grids, it holds all their members, and none need be exchanged.
    """
    n_grids = _number_of_grids(sources.size, n_points)
    if not sources.known and n_grids % layout.n_ranks != 0:
        complete_points(layout, sources, n_dims)
    begin, end = np.int64(0), np.int64(1)
    if n_grids > 1:
        begin, end = local_range(layout, n_grids, BLOCKS)
    for m in range(begin, end):
        i, j = local_range(RankLayout(m, n_grids, 0), sources.size, MEMBERS)
        grid = grids[0, m * n_points : (m + 1) * n_points]
        _add_stretch(sources, i, j, n_dims, box, windows, grid)
    if n_grids > 1:
        allgather(layout, grids[:, : n_grids * n_points], n_points)
    total = grids[0]
    for m in range(1, n_grids):
        grid = grids[0, m * n_points : (m + 1) * n_points]
        for point in range(n_points):
            total[point] += grid[point]
    return total


@njit_internal
def _sum_targets(windows, n_dims, start, stride, grid, out):
    cell, lead, ratio = windows
    for i in range(out.size):
        at = start + np.int64(cell[0, i])
        if n_dims == 1:
            out[i] = sum_line(grid, at, stride, lead[0, i], ratio[0, i], 1.0, 0.0)
        else:
            at += stride * np.int64(cell[1, i])
            out[i] = sum_plane(grid, at, stride, lead[0, i], ratio[0, i], lead[1, i], ratio[1, i])


@njit_internal
def _blur(n_dims, columns, rows, grid, other):
    """Blur ``grid``, whose rows have a margin of `_BLUR` points on either side.

    Return the array that holds the result and the index of its first point.
    """
    wide, below = columns + 2 * _BLUR, (n_dims - 1) * _BLUR * columns
    for row in range(rows):
        for j in range(0, columns, LANES):
            _blur_lanes(grid, row * wide + _BLUR + j, 1, other, below + row * columns + j)
    if n_dims == 1:
        return other, below
    for i in range(below):
        other[i] = 0.0
        other[below + rows * columns + i] = 0.0
    for i in range(0, rows * columns, LANES):
        _blur_lanes(other, below + i, columns, grid, i)
    return grid, 0


@njit_internal
def gridded_sums(layout, sources, targets, n_dims, work):
    """sum_l w_l exp(-|y_l - v_i|^2) at the rank's targets, in one or two directions.

    Zero at targets outside the grid. Members of other ranks are exchanged as needed. Returns False
    if the grid would be too large.
    """
    windows, lanes, ranges, (first, extent), (grids, other) = work
    cell, lead, ratio = windows
    begin, end = local_range(layout, targets.size, MEMBERS)
    sums = targets.rows[0, begin:end]
    for i in range(sums.size):
        sums[i] = 0.0
    _find_ranges(layout, sources, targets, n_dims, lanes, ranges)
    extent[1] = 1.0
    for a in range(n_dims):
        first[a], extent[a] = _extent(ranges[4 * a : 4 * a + 4])
    if extent[0] == 0.0 or extent[1] == 0.0:
        return True
    n_points = (extent[0] + 2.0 * _BLUR) * (extent[1] + 2.0 * _BLUR * (n_dims - 1))
    if n_points > min(other.size, 0.25 * sources.size * targets.size):
        return False
    columns, rows = np.int64(extent[0]), np.int64(extent[1])
    n_added, box = rows * (columns + 2 * _BLUR), (first, extent)
    grid = _add_all(layout, sources, n_dims, n_added, box, windows, grids)
    blurred, start = _blur(n_dims, columns, rows, grid, other)
    for a in range(n_dims):
        v = targets.rows[1 + a, begin:end]
        _place(v, first[a], extent[a], cell[a], lead[a], ratio[a])
    _sum_targets(windows, n_dims, start, columns, blurred, sums)
    return True
