"""Predictions of a guided filter: copies of its particles that move without the guide.

Guided particles are where the next observation is, and none of them where else it could have been.
There are copies only if a callback is there to see them.
"""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import copy_into, njit_internal
from ..plan import initialise, propagate_guided
from .callbacks import PREDICTED, emit
from .guide import leave_unguided
from .loop import Members
from .noise import initial_rows, process_normals

_NUMBER_BYTES = 8


class Copies(NamedTuple):
    """States (n, N) and weights of the copies, and the gains of a step without guidance."""

    members: Members
    gains: np.ndarray


@njit_internal
def start_copies(system, noise, members, callback, local):
    """Copies at step 0, drawn without the guide."""
    n, m = system.n, system.m
    size = local.size if callback[0] != 0 else 0
    rows, log_w = np.zeros((n + 1, size)), np.empty(size)  # the last row for density ratios
    gains = np.zeros(1 + m + m * n + m * (m + 1) // 2)
    leave_unguided(gains, n, m)
    copies = Members(
        X=rows[:n], D=members.D, X_f=members.X_f, w=members.w, log_w=log_w, log_p=members.log_p,
        alive=members.alive,
    )  # fmt: skip
    if size:
        initialise(system, initial_rows(noise).ctypes.data, local.width, copies.X)
        for i in range(size):
            log_w[i] = -math.log(local.n_members)
    return Copies(copies, gains)


@njit_internal
def predict(system, record, noise, j, k, copies, callback, nothing, ancestors, local):
    """Move the copies to step k, and show them; at step 0 they are there."""
    if callback[0] == 0:
        return
    if k > 0:
        gains = np.int64(copies.gains.ctypes.data) + _NUMBER_BYTES
        t, z = record.t0 + (k - 1) * system.dt, process_normals(noise, k - 1)
        propagate_guided(system, k - 1, t, z, local.width, copies.members.X, gains)
    emit(callback, PREDICTED, j, k, copies.members, nothing, ancestors)


@njit_internal
def copy_again(members, copies, callback):
    """Begin anew from the particles after an update."""
    if callback[0] == 0:
        return
    copy_into(copies.members.log_w, members.log_w)
    for a in range(members.X.shape[0]):
        copy_into(copies.members.X[a], members.X[a])
