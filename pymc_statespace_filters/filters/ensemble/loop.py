"""The loop of every ensemble filter: predict up to an observation, update, record the increment."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import carray, types

from pymc_statespace_filters.compiler.native.cache_key import digest
from pymc_statespace_filters.compiler.native.entry_point import (
    F64_PTR,
    I64_PTR,
    EntryPoint,
    arguments_class,
)
from pymc_statespace_filters.compiler.native.jit import inline_always, njit_internal
from pymc_statespace_filters.compiler.numerics.normals import FILL_NORMALS
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
)
from pymc_statespace_filters.filters.ensemble.partition import RankLayout
from pymc_statespace_filters.filters.ensemble.reductions import local_partition
from pymc_statespace_filters.filters.outcomes import NONE, is_missing
from pymc_statespace_filters.filters.system_table import (
    SYSTEM_ARGUMENTS,
    initialise,
    propagate,
    read_system,
)

FILTER_ARGUMENTS = SYSTEM_ARGUMENTS | {
    "settings": F64_PTR,  # number of members, the five `NoiseSizes`, then the filter's settings
    "steps": I64_PTR, "n_observations": types.intp, "observed": F64_PTR, "t0": types.float64,
    "seed": types.int64, "normals": F64_PTR, "n_normals": types.intp,  # stored normals, if any
    "order": types.intp,  # address of the function that sorts particles, 0 if none does
    "callback": types.intp, "integers": types.intp, "reals": types.intp,  # see `callbacks`
    "rank": types.intp, "n_ranks": types.intp, "exchange": types.intp,  # see `partition`
    "terms": F64_PTR, "n_effective": F64_PTR, "health": F64_PTR,
}  # fmt: skip

FilterArguments = arguments_class("FilterArguments", FILTER_ARGUMENTS, __name__)

N_LEADING = 6
"""Settings of every filter: the number of members and five of `NoiseSizes`."""


class Members(NamedTuple):
    """The local members of a filter, as columns, and what every update needs of them.

    ``w`` and ``log_w`` are the normalised weights; ``log_w`` is kept from one observation to the
    next. ``D`` (p, N), ``X_f`` (n, N), ``log_p`` and ``alive`` belong to one update: simulated
    observations, the forecast before the analysis, log p(d | x), and which members are finite.
    """

    X: np.ndarray
    D: np.ndarray
    X_f: np.ndarray
    w: np.ndarray
    log_w: np.ndarray
    log_p: np.ndarray
    alive: np.ndarray


class Outcome(NamedTuple):
    """What an update returns.

    ``increment`` is log p(d_j | d_1 .. d_{j-1}), the log of a mean, and ``n_effective`` the
    effective number of the weights of that mean: below a few, one member decides the increment.
    ``n_weighted`` is the effective number of the weights that the update has left the members,
    which decides whether to resample. ``failure`` is a code of `filters.outcomes`.
    """

    increment: float
    n_effective: float
    n_weighted: float
    failure: int


@inline_always
def failed(failure, n_effective=0.0):
    """The outcome of an update that has failed."""
    return Outcome(-np.inf, n_effective, 0.0, failure)


@njit_internal
def new_members(X, p, local):
    """Members of equal weight with the states X."""
    N = local.size
    log_w = np.empty(N)
    for i in range(N):
        log_w[i] = -math.log(local.n_members)
    return Members(
        X=X, D=np.empty((p, N)), X_f=np.empty(X.shape), w=np.empty(N), log_w=log_w,
        log_p=np.empty(N), alive=np.empty(N, np.bool_),
    )  # fmt: skip


@inline_always
def n_sums(system):
    """Enough rows of sums for the weights, means and covariances of an update."""
    return 8 + 2 * (system.n + system.p) ** 2


@njit_internal
def noise_of_rank(seed, normals, given, steps, local):
    """The normals of this rank: padded to its own width, else of the sizes that the filter gave."""
    sizes = NoiseSizes(local.width, int(given[2]), int(given[3]), int(given[4]), int(given[5]))
    n_steps = steps[-1] if steps.size else np.int64(0)
    return noise_of(seed, normals, sizes, n_steps, local.first_block)


class _NoResampling(NamedTuple):
    ancestors: np.ndarray


@njit_internal
def no_resampler(settings, order, n, local):
    """Workspace of a filter that does not resample."""
    return _NoResampling(np.empty(0, np.int64))


@njit_internal
def no_resampling(resampler, noise, j, k, n_weighted, members, local):
    """Keep all members."""
    return False


def ensemble_filter(
    name: str,
    workspace: Callable,
    update: Callable,
    n_settings: int,
    *,
    resampler: Callable = no_resampler,
    resample: Callable = no_resampling,
) -> EntryPoint:
    """Make a filter one compiled function for all systems and numbers of members.

    Parameters
    ----------
    name : str
    workspace : njit function ``(system, local, settings) -> tuple``
        Allocates, once per evaluation, what ``update`` needs besides the members, and reads the
        filter's settings. ``system`` is a `TabledSystem`, ``local`` a `LocalPartition`: which of
        all members are here.
    update : njit function
        ``(system, j, k, t, d, noise, members, local, work) -> Outcome``. Replaces the forecast
        members by the analysis of observation j at step k, with normalised weights. What it
        returns, and where it branches, is the same on all ranks.
    n_settings : int
        How many settings, as numbers, the filter has besides the number of members.
    resampler, resample : njit functions, optional
        ``(settings, order, n, local) -> workspace`` with an array ``ancestors``, and
        ``(workspace, noise, j, k, n_weighted, members, local) -> whether members were resampled``.

    Returns
    -------
    EntryPoint
        Writes ``terms``, ``n_effective`` of every term, which stays NaN where there is none, and
        ``health`` (see `filters.protocol`). A filter of this package is cached
        on disk; another one is compiled once per process.
    """

    def run(
        table, dt, theta, n_theta, inputs, n_rows, settings, steps, n_observations, observed, t0,
        seed, normals, n_normals, order, callback, integers, reals, rank, n_ranks, exchange,
        terms, n_effective, health,
    ):  # fmt: skip
        given = carray(settings, (N_LEADING + n_settings,))
        system = read_system(table, dt, theta, n_theta, inputs, n_rows)
        n_members = int(given[0])
        local = local_partition(RankLayout(rank, n_ranks, exchange), n_members, n_sums(system))
        at, record = carray(steps, (n_observations,)), carray(observed, (n_observations, system.p))
        out, state = carray(terms, (n_observations,)), carray(health, (3,))
        numbers = carray(n_effective, (n_observations,))
        noise = noise_of_rank(seed, carray(normals, (n_normals,)), given, at, local)
        work = workspace(system, local, given[N_LEADING:])
        resampling = resampler(given[N_LEADING:], order, system.n, local)
        members = new_members(np.empty((system.n, local.size)), system.p, local)
        width = local.width
        to = (callback, integers, reals)
        state[0], state[1], state[2] = n_members, NONE, -1
        initialise(system, initial_normals(noise), width, members.X)
        k = np.int64(0)
        nothing, ancestors = np.empty(0), resampling.ancestors
        emit(to, FORECAST, -1, k, members, nothing, ancestors)
        for j in range(n_observations):
            while k < at[j]:
                propagate(system, k, t0 + k * dt, process_normals(noise, k), width, members.X)
                k += 1
                emit(to, FORECAST, j, k, members, nothing, ancestors)
            if is_missing(record, j):
                out[j] = 0.0
                continue
            found = update(system, j, k, t0 + k * dt, record[j], noise, members, local, work)
            numbers[j] = found.n_effective
            state[0] = min(state[0], found.n_effective)
            if found.failure != NONE:
                state[1], state[2] = found.failure, j
                break
            out[j] = found.increment
            emit(to, UPDATED, j, k, members, record[j], ancestors)
            if resample(resampling, noise, j, k, found.n_weighted, members, local):
                emit(to, RESAMPLED, j, k, members, nothing, ancestors)
        if state[1] == NONE:
            emit(to, ENDED, n_observations, k, members, nothing, ancestors)

    key = _key(name, n_settings, workspace, update, resampler, resample)
    return EntryPoint(run, FILTER_ARGUMENTS, name, key, needs=(FILL_NORMALS,))


def _key(name: str, n_settings: int, *functions: Callable) -> str | None:
    """The key on disk; None for code outside the package, which the key would not cover."""
    package = __name__.partition(".")[0]
    if any(function.__module__.partition(".")[0] != package for function in functions):
        return None
    parts = (f"{function.__module__}.{function.__qualname__}" for function in functions)
    return digest(name, str(n_settings), *parts)
