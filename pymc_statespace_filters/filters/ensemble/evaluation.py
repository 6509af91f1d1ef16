"""One evaluation of a filter with members: what its functions read, members, and their state."""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import copy_into, inline_always, njit_internal
from ...compiler.native.plan import NORMALS, REQUEST, STATE
from ..calls import OK, Record, reals_at, state_given
from ..plan import PLAN, SystemPointers, read_system, settings_of
from ..state_law import Layout
from .callbacks import emit
from .noise import Noise, NoiseSizes, n_stored, noise_of, sizes_of
from .reductions import MEMBERS, LocalPartition, RankLayout, allgather, local_partition
from .resampling import Resampling, resampler

N_LEADING = 8
"""Settings of every filter: the number of members, five of `NoiseSizes`, and two of resampling:
below which fraction of the members, and the number of the scheme. The layout follows, see
`layout_of`, then the filter's own settings."""


@njit_internal
def layout_of(plan):
    """The layout of the parts of a filter, and the filter's own settings."""
    given = settings_of(plan)[N_LEADING:]
    order = np.empty(int(given[2]), np.int64)
    for a in range(order.size):
        order[a] = int(given[3 + a])
    return Layout(int(given[0]), int(given[1]), order), given[3 + order.size :]


class Evaluation(NamedTuple):
    """One evaluation of a filter: all that its functions read.

    ``state`` is what the filter goes on from, empty where it starts. ``settings`` are the filter's
    own, as numbers. A part has ``n_rows`` numbers. ``local`` says which of all members are here:
    with MPI other ranks have the others, and `reductions` sums over all. ``nothing`` is an empty
    vector.
    """

    plan: np.ndarray
    system: SystemPointers
    record: Record
    state: np.ndarray
    settings: np.ndarray
    n_rows: int
    noise: Noise
    local: LocalPartition
    resampling: Resampling
    observer: tuple
    nothing: np.ndarray


class Members(NamedTuple):
    """The local members of a filter, as columns, and what every update needs of them.

    ``w`` and ``log_w`` are the normalised weights; ``log_w`` is kept from one observation to the
    next. ``D`` (p, N), ``X_f`` (n, N), ``log_p`` and ``alive`` belong to one update: simulated
    observations, the forecast before the analysis, log p(d | x), and which members are finite.
    ``behind`` (N,) follows X in memory: a number that a function of members writes for each.
    """

    X: np.ndarray
    D: np.ndarray
    X_f: np.ndarray
    w: np.ndarray
    log_w: np.ndarray
    log_p: np.ndarray
    alive: np.ndarray
    behind: np.ndarray


@njit_internal
def new_members(n, p, local):
    """Members of equal weight, n zeros each."""
    N = local.size
    rows, log_w = np.zeros((n + 1, N)), np.empty(N)
    for i in range(N):
        log_w[i] = -math.log(local.n_members)
    return Members(
        X=rows[:n], D=np.empty((p, N)), X_f=np.empty((n, N)), w=np.empty(N), log_w=log_w,
        log_p=np.empty(N), alive=np.empty(N, np.bool_), behind=rows[n],
    )  # fmt: skip


@inline_always
def members_with(members, X, log_w):
    """Other states and weights, to be shown, with the same scratch."""
    return Members(
        X=X, D=members.D, X_f=members.X_f, w=members.w, log_w=log_w, log_p=members.log_p,
        alive=members.alive, behind=members.behind,
    )  # fmt: skip


@inline_always
def n_sums(system):
    """Enough rows of sums for the weights, means and covariances of an update."""
    return 8 + 2 * (system.n + system.p) ** 2


@njit_internal
def _noise_of_rank(seed, request, given, steps, local):
    """The normals of this rank, padded to its own width; and whether stored ones are as many."""
    sizes = sizes_of(given)
    own = NoiseSizes(local.width, sizes[1], sizes[2], sizes[3], sizes[4])
    n_steps = steps[-1] if steps.size else np.int64(0)
    stored = reals_at(request[REQUEST.normals], (request[REQUEST.n_normals],))
    fits = stored.size == 0 or stored.size == n_stored(sizes, n_steps, steps.size)
    return noise_of(seed, stored, own, n_steps, local.first_block), fits


@inline_always
def _goes_on(state, size, steps, noise):
    """Whether this is a state of the filter before the first row; noise is not stored for parts."""
    fits = state.size == size and noise.stored.size == 0
    return fits and (steps.size == 0 or state[0] < steps[0])


@njit_internal
def read_evaluation(plan, record, request, seed):
    """All that the functions of a filter read, and a status."""
    given, system = settings_of(plan), read_system(plan, record.theta, record.inputs)
    (n_rows, _, _), own = layout_of(plan)
    layout = RankLayout(request[REQUEST.rank], request[REQUEST.n_ranks], request[REQUEST.exchange])
    local = local_partition(layout, int(given[0]), n_sums(system))
    noise, fits = _noise_of_rank(seed, request, given, record.steps, local)
    state, status = state_given(request), OK
    if not fits:
        status = np.int64(NORMALS)
    elif state.size and not _goes_on(state, plan[PLAN.state_size], record.steps, noise):
        status = np.int64(STATE)
    call = Evaluation(
        plan=plan, system=system, record=record, state=state, settings=own, n_rows=n_rows,
        noise=noise, local=local,
        resampling=resampler(given[6], int(given[7]), plan[PLAN.order], n_rows, local),
        observer=(
            request[REQUEST.observer], request[REQUEST.observer_integers],
            request[REQUEST.observer_reals],
        ),
        nothing=np.empty(0),
    )  # fmt: skip
    return call, status


@inline_always
def time_of(call, k):
    """The time of step k."""
    return call.record.t0 + k * call.system.dt


@inline_always
def show(call, event, j, k, members, d):
    """Call the callback of a run, if there is one."""
    emit(call.observer, event, j, k, members, d, call.resampling.ancestors)


@njit_internal
def _rows_of_state(state, n, local):
    """The members of all ranks in a state, (n + 1, N), the last row their log weights."""
    return state[1:].reshape(n + 1, local.n_members)


@njit_internal
def restore(call, members):
    """Take the members from the state that the filter goes on from; its step."""
    local, (n, _) = call.local, members.X.shape
    rows, end = _rows_of_state(call.state, n, local), local.first + local.size
    for a in range(n):
        copy_into(members.X[a], rows[a, local.first : end])
    copy_into(members.log_w, rows[n, local.first : end])
    return np.int64(call.state[0])


@njit_internal
def members_of(call):
    """The step and the members of the state that the filter goes on from; else -1 and new ones."""
    members = new_members(call.n_rows, call.system.p, call.local)
    return restore(call, members) if call.state.size else np.int64(-1), members


@njit_internal
def leave(k, members, local, state):
    """Write the state of the filter: the step, the members and their log weights."""
    n, _ = members.X.shape
    rows, end, state[0] = _rows_of_state(state, n, local), local.first + local.size, k
    for a in range(n):
        copy_into(rows[a, local.first : end], members.X[a])
    copy_into(rows[n, local.first : end], members.log_w)
    allgather(local.layout, rows, MEMBERS)
