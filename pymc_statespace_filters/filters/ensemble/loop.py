"""The loop of every ensemble filter: predict up to an observation, update, note the increment."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import carray, types

from pymc_statespace_filters.compiler.native.cache_key import digest
from pymc_statespace_filters.compiler.native.entry_point import F64_PTR, I64_PTR, EntryPoint
from pymc_statespace_filters.compiler.native.jit import inline_always
from pymc_statespace_filters.compiler.numerics.philox import FILL_NORMALS
from pymc_statespace_filters.filters.ensemble.callbacks import (
    ENDED,
    FORECAST,
    RESAMPLED,
    UPDATED,
    emit,
)
from pymc_statespace_filters.filters.ensemble.noise import (
    NoiseSizes,
    initial_normals,
    noise_of,
    process_normals,
    resampling_normals,
)
from pymc_statespace_filters.filters.ensemble.partition import RankLayout
from pymc_statespace_filters.filters.ensemble.reductions import local_partition
from pymc_statespace_filters.filters.ensemble.resampling import resample_if_few, resampler
from pymc_statespace_filters.filters.ensemble.system_table import initialise, propagate, read_system
from pymc_statespace_filters.filters.missing import is_missing
from pymc_statespace_filters.filters.outcomes import NONE

_ARGUMENTS = (
    I64_PTR, types.float64,  # table of the system and its time step
    F64_PTR,  # number of members, sizes of their noise, then the filter's settings
    F64_PTR, types.intp,  # theta
    I64_PTR, types.intp, F64_PTR,  # steps and record
    F64_PTR, types.intp,  # rows of inputs
    types.float64,  # t0
    types.int64, F64_PTR, types.intp,  # seed, stored normals
    types.intp, types.intp, types.intp,  # who watches, see `_witness`, and its two vectors
    types.intp, types.intp, types.intp,  # our share of the members, see `_share`
    F64_PTR, F64_PTR,  # terms, health
)  # fmt: skip

_N_LEADING = 6  # number of members and five of `NoiseSizes`


class Members(NamedTuple):
    """Our own members of a filter, as columns, and what every update needs of them.

    ``w`` and ``log_w`` are the normalised weights, of which ``log_w`` lasts from one observation to
    the next. ``D`` (p, N), ``X_f`` (n, N), ``log_p`` and ``alive`` are an update's own: simulated
    observations, the forecast that it started from, log p(d | x), and who is finite.
    """

    X: np.ndarray
    D: np.ndarray
    X_f: np.ndarray
    w: np.ndarray
    log_w: np.ndarray
    log_p: np.ndarray
    alive: np.ndarray


@inline_always
def _members(n, p, local):
    N = local.size
    log_w = np.empty(N)
    for i in range(N):
        log_w[i] = -math.log(local.n_members)
    return Members(
        np.empty((n, N)), np.empty((p, N)), np.empty((n, N)),
        np.empty(N), log_w, np.empty(N), np.empty(N, np.bool_),
    )  # fmt: skip


@inline_always
def _n_sums(system):
    """Enough rows for the weights, means and covariances of an update."""
    return 8 + 2 * (system.n + system.p) ** 2


@inline_always
def _resampler(settings, n, local):
    return resampler(settings[0], np.int64(settings[1]), n, local)


@inline_always
def _resample(resampling, noise, j, k, n_effective, members, local):
    z = resampling_normals(noise, j, k)
    return resample_if_few(resampling, n_effective, z, members.log_w, members.w, members.X, local)


class _NoResampling(NamedTuple):
    ancestors: np.ndarray


@inline_always
def _no_resampler(settings, n, local):
    return _NoResampling(np.empty(0, np.int64))


@inline_always
def _keep_all(resampling, noise, j, k, n_effective, members, local):
    return False


def filter_entry(
    name: str, workspace: Callable, update: Callable, n_settings: int, *, resamples: bool
) -> EntryPoint:
    """A filter as one function for all systems and numbers of members.

    Parameters
    ----------
    name : str
    workspace : njit function ``(system, own, settings) -> tuple``
        Allocates, once an evaluation, what ``update`` needs beside the members; the filter's
        settings go with it. ``local`` is an `Own`: which of all members these are.
    update : njit function
        ``(system, j, k, t, d, noise, members, own, work) -> (increment, n_effective, failure)``.
        Replaces the forecast members by the analysis of observation j at step k, with normalised
        weights, and returns log p(d_j | d_1 .. d_{j-1}). What it returns, and where it branches,
        is the same on all ranks.
    n_settings : int
        How many settings, as numbers, the filter has besides the number of members.
    resamples : bool
        Whether members are resampled after an update; the first two settings are then the
        threshold and the number of the scheme.

    Returns
    -------
    Entry
        Writes ``terms`` (J,): the increments, 0 for a row that is wholly missing, -inf from a
        failing observation on; and ``health`` (3,): smallest effective number of particles,
        failure code, index of the failing observation or -1.
    """
    make_resampler = _resampler if resamples else _no_resampler
    resample = _resample if resamples else _keep_all

    def run(
        table, dt, settings, theta, n_theta, steps, n_observations, observed, inputs,
        n_rows, t0, seed, normals, n_normals, witness, counts, numbers,
        rank, n_ranks, address, terms, health,
    ):  # fmt: skip
        given = carray(settings, (_N_LEADING + n_settings,))
        n_members = int(given[0])
        system = read_system(table, dt, theta, n_theta, inputs, n_rows)
        local = local_partition(RankLayout(rank, n_ranks, address), n_members, _n_sums(system))
        width = local.width
        sizes = NoiseSizes(width, int(given[2]), int(given[3]), int(given[4]), int(given[5]))
        at = carray(steps, (n_observations,))
        record = carray(observed, (n_observations, system.p))
        out, state = carray(terms, (n_observations,)), carray(health, (3,))
        n_steps = at[n_observations - 1] if n_observations else np.int64(0)
        noise = noise_of(seed, carray(normals, (n_normals,)), sizes, n_steps, local.first_block)
        work = workspace(system, local, given[_N_LEADING:])
        resampling = make_resampler(given[_N_LEADING:], system.n, local)
        members = _members(system.n, system.p, local)
        with_callback = (witness, counts, numbers)
        state[0], state[1], state[2] = n_members, NONE, -1
        initialise(system, initial_normals(noise), width, members.X)
        k = np.int64(0)
        nothing, ancestors = np.empty(0), resampling.ancestors
        emit(with_callback, FORECAST, -1, k, members, nothing, ancestors)
        for j in range(n_observations):
            while k < at[j]:
                propagate(system, k, t0 + k * dt, process_normals(noise, k), width, members.X)
                k += 1
                emit(with_callback, FORECAST, j, k, members, nothing, ancestors)
            if is_missing(record, j):
                out[j] = 0.0
                continue
            increment, n_effective, failure = update(
                system, j, k, t0 + k * dt, record[j], noise, members, local, work
            )
            state[0] = min(state[0], n_effective)
            if failure != NONE:
                state[1], state[2] = failure, j
                break
            out[j] = increment
            emit(with_callback, UPDATED, j, k, members, record[j], ancestors)
            if resample(resampling, noise, j, k, n_effective, members, local):
                emit(with_callback, RESAMPLED, j, k, members, nothing, ancestors)
        if state[1] == NONE:
            emit(with_callback, ENDED, n_observations, k, members, nothing, ancestors)

    return EntryPoint(run, _ARGUMENTS, name, digest(name), needs=(FILL_NORMALS,))
