"""The loop of every ensemble filter: predict up to an observation, update, note the increment."""

from collections.abc import Callable

import numpy as np
from numba import carray, types

from pymc_statespace_filters.filters._failures import NONE
from pymc_statespace_filters.filters._missing import is_missing
from pymc_statespace_filters.filters._noise import (
    NoiseSizes,
    initial_normals,
    noise_of,
    process_normals,
)
from pymc_statespace_filters.filters._random import FILL_NORMALS
from pymc_statespace_filters.filters._system import initialise, propagate, read_system
from pymc_statespace_filters.machine_code import COUNTS, NUMBERS, Entry, digest

_ARGUMENTS = (
    COUNTS, types.float64,  # table of the system and its time step
    NUMBERS,  # number of members, sizes of their noise, then the filter's settings
    NUMBERS, types.intp,  # theta
    COUNTS, types.intp, NUMBERS,  # steps and record
    NUMBERS, types.intp,  # rows of inputs
    types.float64,  # t0
    types.int64, NUMBERS, types.intp,  # seed, stored normals
    NUMBERS, NUMBERS,  # terms, health
)  # fmt: skip

_N_LEADING = 6  # number of members and five of `NoiseSizes`


def filter_entry(name: str, workspace: Callable, update: Callable, n_settings: int) -> Entry:
    """A filter as one function for all systems and numbers of members.

    Parameters
    ----------
    name : str
    workspace : njit function ``(system, n_members, width, settings) -> tuple``
        ``width`` is the number of members padded to whole blocks.
        Allocates what ``update`` needs and keeps what lasts from one observation to the next
        (weights), once an evaluation; the filter's settings go with it.
    update : njit function
        ``(system, j, k, t, d, noise, X, work) -> (increment, n_effective, failure)``. Replaces the
        forecast members X (n, N) by the analysis of observation j at step k and returns
        log p(d_j | d_1 .. d_{j-1}).
    n_settings : int
        How many settings, as numbers, the filter has besides the number of members.

    Returns
    -------
    Entry
        Writes ``terms`` (J,): the increments, 0 for a row that is wholly missing, -inf from a
        failing observation on; and ``health`` (3,): smallest effective number of particles,
        failure code, index of the failing observation or -1.
    """

    def run(
        table, dt, settings, theta, n_theta, steps, n_observations, observed, inputs,
        n_rows, t0, seed, normals, n_normals, terms, health,
    ):  # fmt: skip
        given = carray(settings, (_N_LEADING + n_settings,))
        n_members, width = int(given[0]), int(given[1])
        sizes = NoiseSizes(width, int(given[2]), int(given[3]), int(given[4]), int(given[5]))
        system = read_system(table, dt, theta, n_theta, inputs, n_rows)
        at = carray(steps, (n_observations,))
        record = carray(observed, (n_observations, system.p))
        out, state = carray(terms, (n_observations,)), carray(health, (3,))
        n_steps = at[n_observations - 1] if n_observations else np.int64(0)
        noise = noise_of(seed, carray(normals, (n_normals,)), sizes, n_steps)
        work = workspace(system, n_members, width, given[_N_LEADING:])
        X = np.empty((system.n, n_members))
        state[0], state[1], state[2] = n_members, NONE, -1
        initialise(system, initial_normals(noise), sizes.width, X)
        k = np.int64(0)
        for j in range(n_observations):
            while k < at[j]:
                propagate(system, k, t0 + k * dt, process_normals(noise, k), sizes.width, X)
                k += 1
            if is_missing(record, j):
                out[j] = 0.0
                continue
            increment, n_effective, failure = update(
                system, j, k, t0 + k * dt, record[j], noise, X, work
            )
            state[0] = min(state[0], n_effective)
            if failure != NONE:
                state[1], state[2] = failure, j
                break
            out[j] = increment

    return Entry(run, _ARGUMENTS, name, digest(name), needs=(FILL_NORMALS,))
