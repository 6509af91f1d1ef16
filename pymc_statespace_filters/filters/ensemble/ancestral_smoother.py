"""Smoothing by carrying the past along: what befalls the members befalls their past states too.

Where members are nudged, past states are nudged by the same innovations with gains of their own,

    x_i(k) <- x_i(k) + P_xd P_dd^-1 (d - d_i),   P_xd the covariance of x(k) with the observation,

which is the ensemble Kalman smoother (Evensen and van Leeuwen 2000). Where members are resampled,
past states go the way of their members: a particle's ancestry. Ancestries meet: the longer ago, the
fewer distinct ones. So a state is settled once a fixed lag of later observations is behind it
(Kitagawa 1996), with the weights of that moment; members that are never resampled have no such
lag.

A particle filter that nudges weights the states of the present alone; its past, nudged like an
ensemble's and weighted like its present, is exact for linear systems as its number grows, and else
an approximation.
"""

import math
from typing import Any

import numpy as np
from numba import carray

from pymc_statespace_filters.compiler.lowering.ensemble import Machine
from pymc_statespace_filters.compiler.native.cache_key import digest
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint, address_of
from pymc_statespace_filters.compiler.native.jit import keep_alive, njit_contract, njit_reassoc
from pymc_statespace_filters.compiler.numerics.small_cholesky import (
    cholesky,
    solve_lower,
    solve_lower_transposed,
)
from pymc_statespace_filters.filters.ensemble.callbacks import (
    CALLBACK_ARGUMENTS,
    ENDED,
    FORECAST,
    RESAMPLED,
    UPDATED,
)
from pymc_statespace_filters.filters.ensemble.kalman_update import mark_finite
from pymc_statespace_filters.filters.ensemble.summaries import (
    finite_weights,
    forget_row,
    results,
    summarise_row,
)
from pymc_statespace_filters.filters.missing import is_missing
from pymc_statespace_filters.filters.outcomes import NONE

LAG = 10
"""Observations after which the past of a resampled particle is settled."""

# Whole numbers of the witness: the first ten below; then the free states, the steps of the rows, at
# which observation each is settled, and a slot of first ancestors (N,) for every row kept.
# Real ones: results as `summarise_row` has them, the last weights (N,), and slots of states (n, N).
_N_COUNTS = 10
_N, _MEMBERS, _P, _ROWS, _SLOTS, _SEED, _NUDGES, _FREE, _STORED, _SETTLED = range(_N_COUNTS)


def _carry(counts, numbers, event, j, k, members, log_weights, d, simulated, ancestors):
    of = carray(counts, (_N_COUNTS,))
    n, N, p, R, S, n_free = of[_N], of[_MEMBERS], of[_P], of[_ROWS], of[_SLOTS], of[_FREE]
    whole = carray(counts, (_N_COUNTS + n_free + 2 * R + S * N,))
    free, rows = whole[_N_COUNTS : _N_COUNTS + n_free], whole[_N_COUNTS + n_free :]
    settled_at, origins = rows[R:], rows[2 * R :].reshape(S, N)
    real = carray(numbers, ((3 * n + 1) * R + N + S * n * N,))
    last_log_w = real[(3 * n + 1) * R : (3 * n + 1) * R + N]
    past = real[(3 * n + 1) * R + N :].reshape(S, n, N)
    X, log_w = carray(members, (n, N)), carray(log_weights, (N,))

    if event == FORECAST:
        if of[_STORED] < R and rows[of[_STORED]] == k:
            slot = of[_STORED] % S
            for i in range(N):
                origins[slot, i] = i
                for a in range(n):
                    past[slot, a, i] = X[a, i]
            of[_STORED] += 1
    elif event == UPDATED:
        if of[_NUDGES]:
            datum, D = carray(d, (p,)), carray(simulated, (p, N))
            _nudge_past(past, of[_SETTLED], of[_STORED], last_log_w, datum, D, free)
        last_log_w[:] = log_w
        while of[_SETTLED] < of[_STORED] and settled_at[of[_SETTLED]] <= j:
            _settle(of, real, past, origins, log_w)
    elif event == RESAMPLED:
        parents = carray(ancestors, (N,))
        for row in range(of[_SETTLED], of[_STORED]):
            _follow(parents, past[row % S], origins[row % S])
        last_log_w[:] = log_w
    elif event == ENDED:
        while of[_SETTLED] < of[_STORED]:
            _settle(of, real, past, origins, log_w)


@njit_contract
def _settle(of, real, past, origins, log_w):
    """Write down what is known of the oldest row that is kept."""
    row = of[_SETTLED]
    slot = row % of[_SLOTS]
    w = finite_weights(past[slot], log_w)
    # One number for all rows: neighbours choose the same ancestry while it lives.
    summarise_row(real, of[_ROWS], row, past[slot], w, of[_SEED], 0)
    real[3 * of[_N] * of[_ROWS] + row] = _count_distinct(w, origins[slot])
    of[_SETTLED] += 1


@njit_contract
def _count_distinct(w, origins):
    """How many ancestors the members that have weight come from."""
    seen, count = np.zeros(w.size, np.bool_), 0
    for i in range(w.size):
        if w[i] > 0.0 and not seen[origins[i]]:
            seen[origins[i]] = True
            count += 1
    return count


@njit_contract
def _follow(parents, past, origins):
    """Give every member the past of its parent."""
    old_past, old_origins = past.copy(), origins.copy()
    for i in range(parents.size):
        origins[i] = old_origins[parents[i]]
        for a in range(past.shape[0]):
            past[a, i] = old_past[a, parents[i]]


@njit_contract
def _nudge_past(past, first, end, log_w, d, D, free):
    """Move the free states of rows first to end as `_ensemble.nudge` moves the present ones."""
    p, N = D.shape
    A, V = np.zeros((p, N)), np.zeros((p, N))
    if first == end or not _innovations(log_w, d, D, A, V):
        return
    gain = np.empty(p)
    for row in range(first, end):
        for a in free:
            x = past[row % past.shape[0], a]
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


@njit_contract
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
    v = np.empty(p)
    for i in range(N):
        for b in range(p):
            v[b] = V[b, i]
            A[b, i] *= w[i] / (1.0 - squares)
        solve_lower(P_dd, v)
        solve_lower_transposed(P_dd, v)
        for b in range(p):
            V[b, i] = v[b]
    return True


CARRY = EntryPoint(_carry, CALLBACK_ARGUMENTS, "carry_past", digest("carry_past"))


def past_kernel(evaluate: Any, machine: Machine, n_members: int, *, nudges: bool, lag: int) -> Any:
    """The function (theta, steps, observed, inputs, t0, seed, rows, draw_seed) -> states.

    Parameters
    ----------
    evaluate : njit function
        Of a filter and a system, see `EnsembleFilter.with_callback`.
    machine : Machine
    n_members : int
    nudges : bool
        Whether the filter nudges its members.
    lag : int
        After how many further observations a state is settled.
    """
    CARRY.compile()
    witness, free, n, p, N = CARRY.symbol, machine.free, machine.n, machine.p, n_members

    @njit_contract
    def run(theta, steps, observed, inputs, t0, seed, rows, draw_seed):
        R = rows.size
        settled_at, S = _settlement(rows, steps, observed, lag)
        start = _N_COUNTS + free.size
        counts = np.empty(start + 2 * R + S * N, np.int64)
        counts[_N], counts[_MEMBERS], counts[_P], counts[_ROWS] = n, N, p, R
        counts[_SLOTS], counts[_SEED], counts[_NUDGES], counts[_FREE] = (
            S, draw_seed, np.int64(nudges), free.size,
        )  # fmt: skip
        counts[_STORED], counts[_SETTLED] = 0, 0
        counts[_N_COUNTS:start] = free
        counts[start : start + R] = rows
        counts[start + R : start + 2 * R] = settled_at
        numbers = np.empty((3 * n + 1) * R + N + S * n * N)
        numbers[: (3 * n + 1) * R] = np.nan
        numbers[(3 * n + 1) * R : (3 * n + 1) * R + N] = -math.log(N)
        watch = (address_of(witness), np.int64(counts.ctypes.data), np.int64(numbers.ctypes.data))
        _, health = evaluate(theta, steps, observed, inputs, t0, (seed, np.empty(0)), watch)
        keep_alive(counts)
        if health[1] != NONE:
            for row in range(R):
                forget_row(numbers, n, R, row)
        return results(numbers, n, R, health)

    return run


@njit_contract
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
