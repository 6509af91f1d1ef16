"""Sums of weighted Gaussian kernels at many targets, O(N), by way of a lattice of points.

With s the variance of a bell (`_windows.VARIANCE`) and D the lattice spacing, in units of the
kernel's standard deviation, and g and h running over the lattice, in one direction

    exp(-(v - y)^2 / 2) ~ c sum_g sum_h exp(-(v - g)^2 / 2s) exp(-(g - h)^2 / 2(1 - 2s))
                            exp(-(h - y)^2 / 2s),    c = D^2 / (2 pi s sqrt(1 - 2s)).

So each member y adds its bell to the lattice, the lattice is blurred, and each target v sums the
lattice under its own bell. In two directions all three are products.

Seen as a function of g and h, the summand is the left side times a Gaussian density, in which g and
h have variance s (1 - s). By Poisson's formula the relative error of the sums is therefore
4 exp(-2 pi^2 s (1 - s) / D^2) = 5e-10 for every single pair of member and target, however far
apart, and twice that in two directions: all terms are positive, nothing cancels. What is beyond the
windows and the blur is below 2e-15 of the total weight, so 2e-9 of a sum at the `FLOOR`. Smaller
sums, in the far tails, are the caller's.

A large ensemble adds its members to a few lattices, each its own stretch of them, and these are
added up in their order: however many ranks share that work, the sums are the same.
"""

import math

import numpy as np

from pymc_statespace_filters.compiler.native.jit import inline_always, njit_contract
from pymc_statespace_filters.compiler.numerics.philox import BLOCK
from pymc_statespace_filters.compiler.numerics.restricted_domain import exp
from pymc_statespace_filters.filters.ensemble.partition import (
    BLOCKS,
    MEMBERS,
    RankLayout,
    allgather,
    local_range,
)
from pymc_statespace_filters.filters.kernel_density.points import complete_points
from pymc_statespace_filters.filters.kernel_density.simd_windows import (
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
"""Sums below this share of the total weight are left to the caller."""

_NEGLIGIBLE = 1e-25  # smaller weights add nothing to sums above the floor, but denormal numbers
_FAR = 8.6  # nor do members that are farther than this from all targets: exp(-FAR^2 / 2) < 1e-16
_BLUR = 16  # lattice points on either side; an even number
_ONE_LATTICE = 8192  # members; more of them are divided among several
_MOST_LATTICES = 8
_POINTS_A_MEMBER = (
    4  # of all lattices: to clear them and add them up is then a fiftieth of the work
)
_BLUR_VARIANCE = 1.0 - 2.0 * VARIANCE
_blur_lanes = taps_sum(
    (SPACING**2 / (2.0 * math.pi * VARIANCE * math.sqrt(_BLUR_VARIANCE)))
    * np.exp(-((SPACING * np.arange(_BLUR + 1)) ** 2) / (2.0 * _BLUR_VARIANCE))
)
_POINTS_PER_UNIT = math.sqrt(2.0) / SPACING  # coordinates come divided by the root of 2
_WITHIN = _FAR * math.sqrt(0.5)


@njit_contract
def lattice_workspace(n_ranks, width):
    """Scratch of ``lattice_sums`` for a padded number of members.

    The windows of members or targets (the first cell, the lead and the ratio of a bell), lanes of a
    minimum and a maximum, the ranges that each rank has found, where the lattice begins and how far
    it goes, and two arrays for lattices, with room for several times the points that an ensemble of
    two states covers.
    """
    bells = np.empty((2, width)), np.empty((2, width)), np.empty((2, width))
    lanes, ranges = (np.empty(BLOCK), np.empty(BLOCK)), np.empty((8, n_ranks))
    room = 32768 + 8 * width
    return bells, lanes, ranges, (np.empty(2), np.empty(2)), (np.empty((1, room)), np.empty(room))


@njit_contract
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


@inline_always
def _find_ranges(layout, sources, targets, n_dims, lanes, ranges):
    """Lowest and highest of members and of targets in each direction, as each rank finds them.

    The sums of the targets are zeros.
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


@inline_always
def _extent(ranges):
    """Where the lattice must be: its first coordinate, and a number of points.

    Members farther than ``_WITHIN`` from all targets stay outside, and targets so far from all
    members; there are no points if that leaves nothing.
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


@njit_contract
def _place(y, first, n_points, cell, lead, ratio):
    """The windows at coordinates: first cell, lead and ratio. Outside the lead is zero."""
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


@inline_always
def _weigh(w, lead):
    for i in range(w.size):
        lead[i] *= w[i] if w[i] > _NEGLIGIBLE else 0.0


@inline_always
def _add_members(bells, n, n_dims, stride, lattice):
    cell, lead, ratio = bells
    for i in range(n):
        if lead[0, i] > 0.0:
            at = _BLUR + np.int64(cell[0, i])
            if n_dims == 1:
                add_to_line(lattice, at, stride, lead[0, i], ratio[0, i], 1.0, 0.0)
            else:
                at += stride * np.int64(cell[1, i])
                add_to_plane(lattice, at, stride, lead[0, i], ratio[0, i], lead[1, i], ratio[1, i])


@inline_always
def _choose_lattices(n_members, n_points):
    """How many lattices share the members: a power of two, as numbers of ranks often are."""
    n_lattices = 1
    if n_members > _ONE_LATTICE:
        most = min(float(_MOST_LATTICES), _POINTS_A_MEMBER * n_members / n_points)
        while 2 * n_lattices <= most:
            n_lattices *= 2
    return n_lattices


@inline_always
def _add_stretch(sources, i, j, n_dims, place, bells, lattice):
    """Make a lattice of the members from i on to before j."""
    (first, extent), (cell, lead, ratio) = place, bells
    for point in range(lattice.size):
        lattice[point] = 0.0
    for a in range(n_dims):
        _place(sources.rows[1 + a, i:j], first[a], extent[a], cell[a], lead[a], ratio[a])
    _weigh(sources.rows[0, i:j], lead[0])
    _add_members(bells, j - i, n_dims, np.int64(extent[0]) + 2 * _BLUR, lattice)


@inline_always
def _add_all(layout, sources, n_dims, n_points, place, bells, lattices):
    """The sum of the lattices of all members, of n_points each.

    The members of a lattice are those that a rank would have if there were as many ranks: where
    each rank has as many lattices, their members are its own.
    """
    n_lattices = _choose_lattices(sources.size, n_points)
    if not sources.known and n_lattices % layout.n_ranks != 0:
        complete_points(layout, sources, n_dims)
    begin, end = np.int64(0), np.int64(1)
    if n_lattices > 1:
        begin, end = local_range(layout, n_lattices, BLOCKS)
    for m in range(begin, end):
        i, j = local_range(RankLayout(m, n_lattices, 0), sources.size, MEMBERS)
        lattice = lattices[0, m * n_points : (m + 1) * n_points]
        _add_stretch(sources, i, j, n_dims, place, bells, lattice)
    if n_lattices > 1:
        allgather(layout, lattices[:, : n_lattices * n_points], n_points)
    total = lattices[0]
    for m in range(1, n_lattices):
        lattice = lattices[0, m * n_points : (m + 1) * n_points]
        for point in range(n_points):
            total[point] += lattice[point]
    return total


@inline_always
def _sum_targets(bells, n_dims, start, stride, lattice, out):
    cell, lead, ratio = bells
    for i in range(out.size):
        at = start + np.int64(cell[0, i])
        if n_dims == 1:
            out[i] = sum_line(lattice, at, stride, lead[0, i], ratio[0, i], 1.0, 0.0)
        else:
            at += stride * np.int64(cell[1, i])
            out[i] = sum_plane(
                lattice, at, stride, lead[0, i], ratio[0, i], lead[1, i], ratio[1, i]
            )


@inline_always
def _blur(n_dims, columns, rows, lattice, other):
    """Blur ``lattice``, which has room for the taps beside its rows.

    Return the array of the result, and where in it the result begins.
    """
    wide, below = columns + 2 * _BLUR, (n_dims - 1) * _BLUR * columns
    for row in range(rows):
        for j in range(0, columns, LANES):
            _blur_lanes(lattice, row * wide + _BLUR + j, 1, other, below + row * columns + j)
    if n_dims == 1:
        return other, below
    for i in range(below):
        other[i] = 0.0
        other[below + rows * columns + i] = 0.0
    for i in range(0, rows * columns, LANES):
        _blur_lanes(other, below + i, columns, lattice, i)
    return lattice, 0


@njit_contract
def lattice_sums(layout, sources, targets, n_dims, work):
    """sum_l w_l exp(-|y_l - v_i|^2) at a rank's own targets, in one or two directions.

    Zero where it is not known. What a rank needs to know of others' members it learns here. Returns
    False if the lattice would be too large.
    """
    bells, lanes, ranges, (first, extent), (lattices, other) = work
    cell, lead, ratio = bells
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
    n_added, place = rows * (columns + 2 * _BLUR), (first, extent)
    lattice = _add_all(layout, sources, n_dims, n_added, place, bells, lattices)
    blurred, start = _blur(n_dims, columns, rows, lattice, other)
    for a in range(n_dims):
        v = targets.rows[1 + a, begin:end]
        _place(v, first[a], extent[a], cell[a], lead[a], ratio[a])
    _sum_targets(bells, n_dims, start, columns, blurred, sums)
    return True
