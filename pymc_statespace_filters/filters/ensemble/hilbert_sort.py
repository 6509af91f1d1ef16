"""An order of particles in which neighbours are close, and which moves little when they do.

One direction is ordered by the state. Several are ordered along a Hilbert curve through the cube
(-1, 1)^n, into which every direction goes by z / (1 + |z|), z in standard deviations of the
weighted particles. The place on the curve is found as by Skilling (2004), "Programming the Hilbert
curve", here for all particles at once; then places are sorted by their digits (radix sort). O(n N).

A direction without spread is left out. Coordinates are rounded to 32 bits in one direction, 12 in
two and 8 in more, finer than the particles lie apart; those in one cell keep their order.
"""

from typing import NamedTuple

import numpy as np

from pymc_statespace_filters.compiler.native.jit import inline_always, njit_contract, njit_reassoc
from pymc_statespace_filters.filters.ensemble.kalman_update import mean

MOST_STATES = 8  # of 8 bits each: a place on the curve is one 64-bit number

_BITS = (32, 12, 8)  # of a coordinate in one, two and more directions
_DIGIT_BITS = 8
_DIGITS = 1 << _DIGIT_BITS
_KNOWN = 1e-13  # a spread below this share of the mean is rounding noise of a value known exactly


class OrderWork(NamedTuple):
    """Scratch of `order_particles`: moments of the states, coordinates, and what is sorted."""

    x_mean: np.ndarray
    spread: np.ndarray
    cells: np.ndarray
    keys: np.ndarray
    moved_keys: np.ndarray
    order: np.ndarray
    moved_order: np.ndarray
    counts: np.ndarray


@inline_always
def order_workspace(n, n_particles):
    """Scratch for particles of n states."""
    N = n_particles
    return OrderWork(
        np.empty(n), np.empty(n), np.empty((n, N), np.int64),
        np.empty(N, np.int64), np.empty(N, np.int64),
        np.empty(N, np.int64), np.empty(N, np.int64),
        np.empty(_DIGITS, np.int64),
    )  # fmt: skip


@njit_contract
def order_particles(w, X, work):
    """The order of the particles X (n, N) with weights w: an array of ``work``, of their numbers.

    Particles of zero weight may be NaN or infinite, and stand anywhere.
    """
    mean(w, X, work.x_mean)
    _spreads(w, X, work.x_mean, work.spread)
    n_active = 0
    for a in range(X.shape[0]):
        n_active += work.spread[a] > _KNOWN * abs(work.x_mean[a])
    n_bits = _BITS[min(max(n_active, 1), len(_BITS)) - 1]
    cells = work.cells[:n_active]
    _fill_cells(X, work.x_mean, work.spread, n_bits, cells)
    if n_active == 1:
        keys, cell = work.keys, cells[0]
        for i in range(keys.size):
            keys[i] = cell[i]
    else:
        undo_turns(cells, n_bits)
        read_places(cells, n_bits, work.keys)
    return _sort(n_active * n_bits, work)


@njit_reassoc
def _spreads(w, X, x_mean, out):
    """Weighted standard deviation of each row; members of zero weight may be NaN."""
    for a in range(X.shape[0]):
        total = 0.0
        for i in range(w.size):
            term = w[i] * (X[a, i] - x_mean[a]) ** 2
            total += term if w[i] > 0.0 else 0.0
        out[a] = np.sqrt(total)


@njit_contract
def _fill_cells(X, x_mean, spread, n_bits, cells):
    """Number of the cell, from 0 to 2^n_bits - 1, in each direction that has spread."""
    half, last = 0.5 * (1 << n_bits), (1 << n_bits) - 1
    row = 0
    for a in range(X.shape[0]):
        if not spread[a] > _KNOWN * abs(x_mean[a]):
            continue
        x, cell, origin, scale = X[a], cells[row], x_mean[a], 1.0 / spread[a]
        for i in range(x.size):
            z = scale * (x[i] - origin)
            place = half + half * (z / (1.0 + abs(z)))
            # False for NaN too, whose conversion to an integer is anything.
            cell[i] = np.int64(place) if place < last else last
        row += 1


@njit_contract
def undo_turns(cells, n_bits):
    """Turn each point, level by level, as the curve in its cell is turned against the whole curve.

    Every level halves all directions. In a half of set bit the curve runs with the first direction
    mirrored, in one of cleared bit with the first direction and this one exchanged; both concern
    the levels below. Skilling's loop, with particles innermost.
    """
    for level in range(n_bits - 1, 0, -1):
        below = (np.int64(1) << level) - 1
        first = cells[0]
        for a in range(cells.shape[0]):
            cell = cells[a]
            for i in range(cell.size):
                x, y = first[i], cell[i]
                is_set = (y >> level) & 1 == 1
                turn = below if is_set else (x ^ y) & below
                cell[i] = y if is_set else y ^ turn
                first[i] = x ^ turn  # after the line above: they are one row where a is 0


@njit_contract
def read_places(cells, n_bits, keys):
    """Place on the curve: the bits of turned points, level by level, are its Gray code."""
    for i in range(keys.size):
        keys[i] = 0
    for level in range(n_bits - 1, -1, -1):
        for a in range(cells.shape[0]):
            cell = cells[a]
            for i in range(keys.size):
                key = keys[i]
                keys[i] = (key << 1) | ((key ^ (cell[i] >> level)) & 1)


@njit_contract
def _sort(n_bits, work):
    """Numbers of the particles by increasing key, digit by digit from the lowest; ties in order."""
    keys, moved_keys, counts = work.keys, work.moved_keys, work.counts
    order, moved_order = work.order, work.moved_order
    for i in range(order.size):
        order[i] = i
    for shift in range(0, n_bits, _DIGIT_BITS):
        for digit in range(_DIGITS):
            counts[digit] = 0
        for i in range(keys.size):
            counts[(keys[i] >> shift) & (_DIGITS - 1)] += 1
        start = 0
        for digit in range(_DIGITS):
            count = counts[digit]
            counts[digit] = start
            start += count
        for i in range(keys.size):
            digit = (keys[i] >> shift) & (_DIGITS - 1)
            place = counts[digit]
            counts[digit] = place + 1
            moved_keys[place], moved_order[place] = keys[i], order[i]
        keys, moved_keys = moved_keys, keys
        order, moved_order = moved_order, order
    return order
