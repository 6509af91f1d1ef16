"""The loop of every ensemble filter: predict up to an observation, update, record the increment."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...compiler.native.entry_point import EntryPoint
from ...compiler.native.jit import copy_into, inline_always, njit_internal
from ...compiler.native.plan import NORMALS, REQUEST, STATE
from ...compiler.numerics.normals import FILL_NORMALS
from ..calls import OK, likelihood_entry, reals_at, state_given
from ..outcomes import NONE, is_missing
from ..plan import PLAN, initialise, propagate, read_system, settings_of
from .callbacks import ENDED, FORECAST, RESAMPLED, UPDATED, emit
from .noise import NoiseSizes, initial_normals, n_stored, noise_of, process_normals, sizes_of
from .origins import effective_number_of_origins, follow_ancestors, new_origins
from .reductions import RankLayout, local_partition

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


@inline_always
def rank_of(request):
    """Which of the ranks that evaluate together this one is."""
    return RankLayout(request[REQUEST.rank], request[REQUEST.n_ranks], request[REQUEST.exchange])


@inline_always
def observer_of(request):
    """The callback that sees the members, see `callbacks`."""
    return (
        request[REQUEST.observer],
        request[REQUEST.observer_integers],
        request[REQUEST.observer_reals],
    )


@njit_internal
def noise_of_rank(seed, request, given, steps, local):
    """The normals of this rank, padded to its own width; and whether stored ones are as many."""
    sizes = sizes_of(given)
    own = NoiseSizes(local.width, sizes[1], sizes[2], sizes[3], sizes[4])
    n_steps = steps[-1] if steps.size else np.int64(0)
    stored = reals_at(request[REQUEST.normals], (request[REQUEST.n_normals],))
    fits = stored.size == 0 or stored.size == n_stored(sizes, n_steps, steps.size)
    return noise_of(seed, stored, own, n_steps, local.first_block), fits


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


@njit_internal
def _dump(k, members, state):
    """Write the step, the members and their log weights to a vector."""
    n, N = members.X.shape
    state[0] = k
    for a in range(n):
        copy_into(state[1 + a * N : 1 + (a + 1) * N], members.X[a])
    copy_into(state[1 + n * N :], members.log_w)


@njit_internal
def _restore(state, members):
    """Read what `_dump` wrote; returns the step."""
    n, N = members.X.shape
    for a in range(n):
        copy_into(members.X[a], state[1 + a * N : 1 + (a + 1) * N])
    copy_into(members.log_w, state[1 + n * N :])
    return np.int64(state[0])


@njit_internal
def begin(plan, system, given, noise, width, members, observer, ancestors):
    """Draw the members at step 0, or take those of a state; the step, or -1 of another state."""
    if given.size == 0:
        initialise(system, initial_normals(noise), width, members.X)
        emit(observer, FORECAST, -1, np.int64(0), members, np.empty(0), ancestors)
        return np.int64(0)
    if given.size == plan[PLAN.state_size] and noise.stored.size == 0:
        return _restore(given, members)
    return np.int64(-1)


@njit_internal
def finish(n_rows, k, members, observer, ancestors, to):
    """Tell that a record has ended, unless it has failed, and write the state if it is wanted."""
    is_known = to.health[1] == NONE
    if is_known:
        emit(observer, ENDED, n_rows, k, members, np.empty(0), ancestors)
    if to.state.size:
        _dump(k, members, to.state)
        if not is_known:
            to.state[:] = np.nan


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
        filter's settings. ``system`` is a `SystemPointers`, ``local`` a `LocalPartition`: which of
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

    @njit_internal
    def evaluate(plan, record, request, seed, to):
        given, steps, t0 = settings_of(plan), record.steps, record.t0
        system = read_system(plan, record.theta, record.inputs)
        n_members = int(given[0])
        local = local_partition(rank_of(request), n_members, n_sums(system))
        noise, fits = noise_of_rank(seed, request, given, steps, local)
        if not fits:
            return NORMALS
        work = workspace(system, local, given[N_LEADING:])
        resampling = resampler(given[N_LEADING:], plan[PLAN.order], system.n, local)
        members = new_members(np.empty((system.n, local.size)), system.p, local)
        width, dt, health = local.width, system.dt, to.health
        observer = observer_of(request)
        health[0], health[1], health[2] = n_members, NONE, -1
        if system.failure != NONE:
            health[0], health[1], health[2] = 0.0, system.failure, 0.0
        nothing, ancestors = np.empty(0), resampling.ancestors
        origins = new_origins(plan[PLAN.follows_origins] != 0, local)
        k = begin(plan, system, state_given(request), noise, width, members, observer, ancestors)
        if k < 0:
            return STATE
        for j in range(steps.size if health[1] == NONE else 0):
            while k < steps[j]:
                propagate(system, k, t0 + k * dt, process_normals(noise, k), width, members.X)
                k += 1
                emit(observer, FORECAST, j, k, members, nothing, ancestors)
            d = record.observed[j]
            if is_missing(record.observed, j):
                to.terms[j] = 0.0
                continue
            found = update(system, j, k, t0 + k * dt, d, noise, members, local, work)
            n_effective = found.n_effective
            if origins.own.size and found.failure == NONE:
                n_distinct = effective_number_of_origins(origins, members.w, local)
                n_effective = min(n_effective, n_distinct)
            to.n_effective[j] = n_effective
            health[0] = min(health[0], n_effective)
            if found.failure != NONE:
                health[1], health[2] = found.failure, j
                break
            to.terms[j] = found.increment
            emit(observer, UPDATED, j, k, members, d, ancestors)
            if resample(resampling, noise, j, k, found.n_weighted, members, local):
                follow_ancestors(origins, ancestors)
                emit(observer, RESAMPLED, j, k, members, nothing, ancestors)
        finish(steps.size, k, members, observer, ancestors, to)
        return OK

    parts = (str(n_settings), workspace, update, resampler, resample)
    return likelihood_entry(name, evaluate, parts, needs=(FILL_NORMALS,))
