"""Ensemble Kalman and fixed-lag ancestral smoothing: past states change with the present ones.

Where members are updated, past states are updated by the same innovations with their own gains,

    x_i(k) <- x_i(k) + P_xd P_dd^-1 (d - d_i),   P_xd the covariance of x(k) with the observation,

which is the ensemble Kalman smoother (Evensen and van Leeuwen 2000). Where members are resampled,
past states are resampled with them: a particle's ancestry. Ancestries coalesce: the further back,
the fewer distinct ones. So a state is fixed a given lag of observations later (Kitagawa 1996),
with the weights of that moment; members that are never resampled have no such lag.

A particle filter with Kalman updates weights only the present states. Its past states, updated like
those of an ensemble and weighted like the present ones, are exact for linear systems as the number
of particles grows, and otherwise an approximation.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import carray

from ...compiler.native.entry_point import EntryPoint, pointer
from ...compiler.native.jit import copy_into, inline_always, njit_internal, njit_reassoc
from ...compiler.native.plan import (
    HEALTH_SIZE,
    N_RESULTS,
    RECORD,
    REQUEST,
    RESULTS,
    plan_entry,
)
from ...compiler.numerics.small_cholesky import cholesky, solve_lower, solve_lower_transposed
from ..calls import OK, opened, reals_at, single_record, wanted_rows
from ..outcomes import NONE, is_missing
from ..plan import PLAN, free_states
from .callbacks import CALLBACK_ARGUMENTS, ENDED, FORECAST, RESAMPLED, UPDATED, run_observed
from .kalman_update import mark_finite
from .summaries import finite_weights, forget, places_of, summarise_row

LAG = 10
"""Observations after which the past of a resampled particle is settled."""

NO_LAG = np.iinfo(np.int64).max // 2
"""For members that are never resampled: their past is settled when the record ends."""

# Integers of the callback: the header below; then the free states, the steps of the rows, the
# observation at which each is settled, and a slot of first ancestors (N,) for every row kept.
# Reals: the last weights (N,), and slots of states (n, N).
_N_HEADER = 11
(
    _N, _MEMBERS, _P, _ROWS, _SLOTS, _SEED, _UPDATES, _FREE, _STORED, _SETTLED, _RESULTS
) = range(_N_HEADER)  # fmt: skip


class _Past(NamedTuple):
    """The two vectors of the callback, by name."""

    header: np.ndarray
    free: np.ndarray
    rows: np.ndarray
    settled_at: np.ndarray
    origins: np.ndarray
    last_log_w: np.ndarray
    states: np.ndarray


@inline_always
def _n_integers(header):
    n_rows, slots = 2 * header[_ROWS], header[_SLOTS] * header[_MEMBERS]
    return _N_HEADER + header[_FREE] + n_rows + slots


@inline_always
def _n_reals(header):
    return header[_MEMBERS] * (1 + header[_SLOTS] * header[_N])


@njit_internal
def _past_of(integers, reals):
    """Name the parts of the two vectors."""
    header, whole = integers[:_N_HEADER], integers[_N_HEADER:]
    n, N, R = header[_N], header[_MEMBERS], header[_ROWS]
    S, n_free = header[_SLOTS], header[_FREE]
    return _Past(
        header=header, free=whole[:n_free], rows=whole[n_free : n_free + R],
        settled_at=whole[n_free + R : n_free + 2 * R],
        origins=whole[n_free + 2 * R :].reshape(S, N), last_log_w=reals[:N],
        states=reals[N:].reshape(S, n, N),
    )  # fmt: skip


def _carry_past(integers, reals, event, j, k, X, log_w, d, D, ancestors):
    header = carray(integers, (_N_HEADER,))
    past = _past_of(carray(integers, (_n_integers(header),)), carray(reals, (_n_reals(header),)))
    n, N, p, S = header[_N], header[_MEMBERS], header[_P], header[_SLOTS]
    members, log_weights = carray(X, (n, N)), carray(log_w, (N,))

    if event == FORECAST:
        if header[_STORED] < header[_ROWS] and past.rows[header[_STORED]] == k:
            slot = header[_STORED] % S
            for i in range(N):
                past.origins[slot, i] = i
                for a in range(n):
                    past.states[slot, a, i] = members[a, i]
            header[_STORED] += 1
    elif event == UPDATED:
        if header[_UPDATES]:
            _update_past(past, carray(d, (p,)), carray(D, (p, N)))
        copy_into(past.last_log_w, log_weights)
        while header[_SETTLED] < header[_STORED] and past.settled_at[header[_SETTLED]] <= j:
            _settle(past, log_weights)
    elif event == RESAMPLED:
        parents = carray(ancestors, (N,))
        for row in range(header[_SETTLED], header[_STORED]):
            _resample_past(parents, past.states[row % S], past.origins[row % S])
        copy_into(past.last_log_w, log_weights)
    elif event == ENDED:
        while header[_SETTLED] < header[_STORED]:
            _settle(past, log_weights)


@njit_internal
def _settle(past, log_w):
    """Write the summary of the oldest row that is kept."""
    header = past.header
    row = header[_SETTLED]
    slot = row % header[_SLOTS]
    states, to = past.states[slot], carray(pointer(header[_RESULTS]), (N_RESULTS,), np.int64)
    w = finite_weights(states, log_w)
    # One number for all rows: neighbours choose the same ancestry while it lives.
    summarise_row(to, row, states, w, header[_SEED])
    _, _, _, n_effective = places_of(to, header[_N], row)
    n_effective[0] = _count_distinct(w, past.origins[slot])
    header[_SETTLED] += 1


@njit_internal
def _count_distinct(w, origins):
    """Number of distinct ancestors of the members that have weight."""
    seen, count = np.zeros(w.size, np.bool_), 0
    for i in range(w.size):
        if w[i] > 0.0 and not seen[origins[i]]:
            seen[origins[i]] = True
            count += 1
    return count


@njit_internal
def _resample_past(parents, past, origins):
    """Give every member the past of its parent."""
    old_past, old_origins = past.copy(), origins.copy()
    for i in range(parents.size):
        origins[i] = old_origins[parents[i]]
        for a in range(past.shape[0]):
            past[a, i] = old_past[a, parents[i]]


@njit_internal
def _update_past(past, d, D):
    """Move the free states of all rows kept as `kalman_update` moves the present ones."""
    first, end = past.header[_SETTLED], past.header[_STORED]
    p, N = D.shape
    A, V = np.zeros((p, N)), np.zeros((p, N))
    if first == end or not _innovations(past.last_log_w, d, D, A, V):
        return
    gain = np.empty(p)
    for row in range(first, end):
        for a in past.free:
            x = past.states[row % past.states.shape[0], a]
            for b in range(p):
                gain[b] = _product(A[b], x)
            for b in range(p):
                for i in range(N):
                    x[i] += gain[b] * V[b, i]


@njit_reassoc
def _product(a, x):
    """Sum of a_i x_i; where a_i is zero x_i may be NaN."""
    total = 0.0
    for i in range(a.size):
        term = a[i] * x[i]
        total += term if a[i] != 0.0 else 0.0
    return total


@njit_internal
def _innovations(log_w, d, D, A, V):
    """A, whose product with past states is P_xd, and V = P_dd^-1 (d - d_i); False if none move.

    Members that are not finite, or have no weight, and missing components have zeros.
    """
    p, N = D.shape
    w, alive = np.zeros(N), np.empty(N, np.bool_)
    mark_finite(D, D, alive)
    total, squares = 0.0, 0.0
    for i in range(N):
        w[i] = math.exp(log_w[i]) if alive[i] else 0.0
        total += w[i]
    if not total > 0.0:
        return False
    for i in range(N):
        w[i] /= total
        squares += w[i] * w[i]
    if 1.0 - squares < 1e-10:
        return False
    P_dd = np.eye(p)
    for b in range(p):
        mean = 0.0
        for i in range(N):
            mean += w[i] * D[b, i] if w[i] > 0.0 else 0.0
        for i in range(N):
            if w[i] > 0.0 and not np.isnan(d[b]):
                A[b, i] = D[b, i] - mean
                V[b, i] = d[b] - D[b, i]
    for b in range(p):
        for e in range(p):
            if not (np.isnan(d[b]) or np.isnan(d[e])):
                total = 0.0
                for i in range(N):
                    total += w[i] * A[b, i] * A[e, i]
                P_dd[b, e] = total / (1.0 - squares)
    if not cholesky(P_dd):
        return False
    _solve_innovations(P_dd, w, 1.0 - squares, A, V)
    return True


@njit_internal
def _solve_innovations(P_dd_chol, w, spread, A, V):
    """Weight A for a covariance, and make V the solutions P_dd^-1 V, in place."""
    p, N = V.shape
    v = np.empty(p)
    for i in range(N):
        for b in range(p):
            v[b] = V[b, i]
            A[b, i] *= w[i] / spread
        solve_lower(P_dd_chol, v)
        solve_lower_transposed(P_dd_chol, v)
        for b in range(p):
            V[b, i] = v[b]


CARRY_PAST = EntryPoint(_carry_past, CALLBACK_ARGUMENTS, "carry_past")


@njit_internal
def _settlement(rows, steps, observed, lag):
    """At which observation each row is settled, and how many rows wait for that at most."""
    seen = np.array([j for j in range(steps.size) if not is_missing(observed, j)], np.int64)
    settled_at, most = np.empty(rows.size, np.int64), 1
    first, until = 0, 0  # the first seen observation not before a row; rows there when it settles
    for row in range(rows.size):
        while first < seen.size and steps[seen[first]] < rows[row]:
            first += 1
        # At the last one at the latest, before resampling adds noise.
        within = first < seen.size
        settled_at[row] = seen[min(first + lag, seen.size - 1)] if within else steps.size
        last = steps[settled_at[row]] if within else rows[-1]
        while until < rows.size and rows[until] <= last:
            until += 1
        most = max(most, until - row)
    return settled_at, most


def _smooth(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    if status != OK or call.request[REQUEST.sizes_only]:
        return status
    words, rows = call.plan, wanted_rows(call)
    data = single_record(call, 0, 0, call.record[RECORD.n_rows])
    settled_at, S = _settlement(rows, data.steps, data.observed, words[PLAN.lag])
    header = np.empty(_N_HEADER, np.int64)
    header[_N], header[_MEMBERS], header[_P] = words[PLAN.n], words[PLAN.n_members], words[PLAN.p]
    header[_ROWS], header[_SLOTS], header[_FREE] = rows.size, S, words[PLAN.n_free]
    header[_SEED], header[_UPDATES] = call.request[REQUEST.draw_seed], words[PLAN.updates]
    header[_STORED], header[_SETTLED], header[_RESULTS] = 0, 0, call.results.ctypes.data
    integers, reals = np.empty(_n_integers(header), np.int64), np.empty(_n_reals(header))
    copy_into(integers[:_N_HEADER], header)
    past = _past_of(integers, reals)
    copy_into(past.free, free_states(words))
    copy_into(past.rows, rows)
    copy_into(past.settled_at, settled_at)
    past.last_log_w[:] = -math.log(words[PLAN.n_members])
    forget(call, words[PLAN.n], 0)
    status, _, health = run_observed(call, plan, record, integers, reals)
    if health[1] != NONE:  # nothing is known: a state is given all observations
        forget(call, words[PLAN.n], 0)
    copy_into(reals_at(call.results[RESULTS.health], (HEALTH_SIZE,)), health)
    return status


SMOOTH = plan_entry(_smooth, "ancestral_smoother")
"""Smoothed states by a callback that carries past states along.

The plan says whether the filter moves its members by a Kalman gain, and after how many further
observations a state is settled.
"""
