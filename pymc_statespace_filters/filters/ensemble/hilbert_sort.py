"""Sorting particles so that neighbours in the order are close in state space, in O(n N).

Particles of one state are sorted by it. Those of several states are sorted along a Hilbert curve
through the cube (-1, 1)^n, to which each direction is mapped by z / (1 + |z|), with z in standard
deviations of the weighted particles. The key of a particle is its position on the curve, computed
as in Skilling (2004), "Programming the Hilbert curve", for all particles at once. Keys are sorted
by radix sort.

A direction without spread is left out. Coordinates are rounded to 32 bits in one direction, 12 in
two and 8 in more, finer than the distances between particles; those in one cell keep their order.
"""

from typing import NamedTuple

import numpy as np
from numba import carray, types

from ...compiler.native.entry_point import (
    F64_PTR,
    I64_PTR,
    EntryPoint,
    arguments_class,
    call_address,
)
from ...compiler.native.jit import copy_into, njit_internal, njit_reassoc

MOST_STATES = 8  # of 8 bits each: a key is one 64-bit integer

_BITS = (32, 12, 8)  # of a coordinate in one, two and more directions
_DIGIT_BITS = 8
_DIGITS = 1 << _DIGIT_BITS
_KNOWN = 1e-13  # a smaller spread, relative to the mean, is rounding of a value known exactly


class OrderWork(NamedTuple):
    """Scratch of `order_particles`: moments of the states, cells, keys and indices."""

    x_mean: np.ndarray
    spread: np.ndarray
    cells: np.ndarray
    keys: np.ndarray
    moved_keys: np.ndarray
    order: np.ndarray
    moved_order: np.ndarray
    counts: np.ndarray


@njit_internal
def order_workspace(n, n_particles):
    """Scratch for particles of n states."""
    N = n_particles
    return OrderWork(
        np.empty(n), np.empty(n), np.empty((n, N), np.int64),
        np.empty(N, np.int64), np.empty(N, np.int64),
        np.empty(N, np.int64), np.empty(N, np.int64),
        np.empty(_DIGITS, np.int64),
    )  # fmt: skip


@njit_internal
def order_particles(w, X, work):
    """Indices that sort the particles X (n, N) with weights w; an array of ``work``.

    Particles of zero weight may be NaN or infinite; their place in the order is arbitrary.
    """
    _moments(w, X, work.x_mean, work.spread)
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
        undo_rotations(cells, n_bits)
        read_keys(cells, n_bits, work.keys)
    return _sort(n_active * n_bits, work)


@njit_reassoc
def _moments(w, X, mean, sd):
    """Weighted mean and standard deviation of each row; zero weights may have NaN states."""
    for a in range(X.shape[0]):
        total = 0.0
        for i in range(w.size):
            term = w[i] * X[a, i]
            total += term if w[i] > 0.0 else 0.0
        mean[a] = total
        total = 0.0
        for i in range(w.size):
            term = w[i] * (X[a, i] - mean[a]) ** 2
            total += term if w[i] > 0.0 else 0.0
        sd[a] = np.sqrt(total)


@njit_internal
def _fill_cells(X, x_mean, spread, n_bits, cells):
    """Cell number, from 0 to 2^n_bits - 1, in each direction with spread."""
    half, last = 0.5 * (1 << n_bits), (1 << n_bits) - 1
    row = 0
    for a in range(X.shape[0]):
        if not spread[a] > _KNOWN * abs(x_mean[a]):
            continue
        x, cell, origin, scale = X[a], cells[row], x_mean[a], 1.0 / spread[a]
        for i in range(x.size):
            z = scale * (x[i] - origin)
            position = half + half * (z / (1.0 + abs(z)))
            # The comparison is false for NaN, whose conversion to an integer is undefined.
            cell[i] = np.int64(position) if position < last else last
        row += 1


@njit_internal
def undo_rotations(cells, n_bits):
    """Undo, level by level, the rotation of the curve within each particle's cell.

    Each level halves all directions. In the half with the bit set the first direction of the curve
    is mirrored; in the other half the first direction and this one are exchanged. Both affect the
    levels below. Skilling's loop, with particles innermost.
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
                first[i] = x ^ turn  # must come second: for a = 0 both are the same row


@njit_internal
def read_keys(cells, n_bits, keys):
    """Keys: the bits of the rotated points, level by level, are the key's Gray code."""
    for i in range(keys.size):
        keys[i] = 0
    for level in range(n_bits - 1, -1, -1):
        for a in range(cells.shape[0]):
            cell = cells[a]
            for i in range(keys.size):
                key = keys[i]
                keys[i] = (key << 1) | ((key ^ (cell[i] >> level)) & 1)


@njit_internal
def _sort(n_bits, work):
    """Indices of the particles by increasing key: stable radix sort from the lowest digit."""
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
            position = counts[digit]
            counts[digit] = position + 1
            moved_keys[position], moved_order[position] = keys[i], order[i]
        keys, moved_keys = moved_keys, keys
        order, moved_order = moved_order, order
    return order


_ARGUMENTS = {
    "particles": F64_PTR, "n": types.intp, "n_particles": types.intp, "x_mean": F64_PTR,
    "spread": F64_PTR, "cells": I64_PTR, "keys": I64_PTR, "moved_keys": I64_PTR, "order": I64_PTR,
    "moved_order": I64_PTR, "counts": I64_PTR,
}  # fmt: skip

_Arguments = arguments_class("_Arguments", _ARGUMENTS, __name__)


def _order(
    particles, n, n_particles, x_mean, spread, cells, keys, moved_keys, order, moved_order, counts
):
    N = (n_particles,)
    rows = carray(particles, (1 + n, n_particles))
    work = OrderWork(
        carray(x_mean, (n,)), carray(spread, (n,)), carray(cells, (n, n_particles)),
        carray(keys, N), carray(moved_keys, N), carray(order, N), carray(moved_order, N),
        carray(counts, (_DIGITS,)),
    )  # fmt: skip
    copy_into(work.order, order_particles(rows[0], rows[1:], work))


ORDER_PARTICLES = EntryPoint(_order, _ARGUMENTS, "order_particles")
"""`order_particles`, compiled only for filters that sort."""


@njit_internal
def order_at(address, particles, work):
    """Call `ORDER_PARTICLES` at its address; ``particles`` (1 + n, N) are weights and states."""
    n, n_particles = np.int64(particles.shape[0] - 1), np.int64(particles.shape[1])
    arguments = _Arguments(
        particles=particles, n=n, n_particles=n_particles, x_mean=work.x_mean, spread=work.spread,
        cells=work.cells, keys=work.keys, moved_keys=work.moved_keys, order=work.order,
        moved_order=work.moved_order, counts=work.counts,
    )  # fmt: skip
    call_address(address, arguments)
    return work.order
