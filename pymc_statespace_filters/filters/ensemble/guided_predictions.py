"""Predictions of a guided filter: copies of its particles that move without the guide.

Guided particles are where the next observation is, and none of them where else it could have been.
There are copies only if a callback is there to see them.
"""

import math

import numpy as np

from ...compiler.native.jit import copy_into, njit_internal
from ..plan import initialise, propagate_guided
from .callbacks import PREDICTED
from .evaluation import members_with, show, time_of
from .noise import initial_rows, process_normals

_NUMBER_BYTES = 8


@njit_internal
def _show(call, j, k, particles):
    n, log_w = call.system.n, particles.copies_log_w
    copies = members_with(particles.members, particles.copies[:n], log_w)
    show(call, PREDICTED, j, k, copies, call.nothing)


@njit_internal
def start_copies(call, particles):
    """Draw copies at step 0, without the guide, and show them."""
    z = initial_rows(call.noise).ctypes.data
    initialise(call.system, z, call.local.width, particles.copies[: call.system.n])
    for i in range(particles.copies_log_w.size):
        particles.copies_log_w[i] = -math.log(call.local.n_members)
    _show(call, -1, np.int64(0), particles)


@njit_internal
def move_copies(call, j, k, particles):
    """Move the copies to step k, and show them."""
    gains = np.int64(particles.plain.ctypes.data) + _NUMBER_BYTES
    t, z = time_of(call, k - 1), process_normals(call.noise, k - 1)
    X = particles.copies[: call.system.n]
    propagate_guided(call.system, k - 1, t, z, call.local.width, X, gains)
    _show(call, j, k, particles)


@njit_internal
def copy_again(particles):
    """Begin anew from the particles after an update."""
    copy_into(particles.copies_log_w, particles.members.log_w)
    for a in range(particles.members.X.shape[0]):
        copy_into(particles.copies[a], particles.members.X[a])
