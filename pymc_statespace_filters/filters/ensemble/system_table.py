"""A lowered system as filters see it: sizes, and functions that are called by their address."""

from typing import NamedTuple

import numpy as np
from numba import carray

from pymc_statespace_filters.compiler.native.entry_point import call_address
from pymc_statespace_filters.compiler.native.jit import inline_always

N_TABLE = 10
"""Numbers in the table of a system before its free states."""

NOTHING = np.int64(0)  # an address that is not read


class System(NamedTuple):
    """One evaluation's system: the functions are those of ``lowering.Machine``.

    ``c`` holds the constants of the evaluation, ``inputs`` a row for each step; ``free`` are the
    states that a Kalman update may move.
    """

    n: int
    p: int
    dt: float
    free: np.ndarray
    c: np.ndarray
    inputs: np.ndarray
    initialise: int
    propagate: int
    log_density: int
    observe: int


@inline_always
def read_system(table, dt, theta, n_theta, inputs, n_rows):
    """Prepare the constants and give names to the numbers of a table.

    The table holds n, p, the numbers of inputs, constants and free states, the addresses of
    ``prepare`` and of the four below, then the free states.
    """
    of = carray(table, (N_TABLE,))
    free = carray(table, (N_TABLE + of[4],))[N_TABLE:]
    c = np.empty(of[3])
    call_address(of[5], (theta, n_theta, c))
    return System(
        of[0], of[1], dt, free, c, carray(inputs, (n_rows, of[2])), of[6], of[7], of[8], of[9]
    )


@inline_always
def call_members(address, system, k, t, z, width, X, out):
    """Call a function of all members, by the form that all of them have in `lowering.members`."""
    n_members = np.int64(X.shape[1])
    call_address(address, (system.c, system.inputs, k, t, z, width, X, out, n_members))


@inline_always
def initialise(system, z, width, X):
    """Draw every member's state at step 0 from normals at the address z."""
    call_members(system.initialise, system, NOTHING, 0.0, z, width, X, NOTHING)


@inline_always
def propagate(system, k, t, z, width, X):
    """Move every member from step k to k + 1 with its own noise (Eqs. 4.22 and 4.40)."""
    call_members(system.propagate, system, k, t, z, width, X, NOTHING)


@inline_always
def observe(system, k, t, z, width, X, D):
    """Simulate an observation of every member (Eq. 4.15)."""
    call_members(system.observe, system, k, t, z, width, X, D)


@inline_always
def log_density(system, k, t, d, X, log_p):
    """Write log p(d | x) of every member; components of d that are NaN are left out."""
    call_members(system.log_density, system, k, t, d, NOTHING, X, log_p)
