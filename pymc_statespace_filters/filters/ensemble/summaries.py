"""Callbacks that summarise or store weighted members: filtered states, and whole runs."""

import math

import numpy as np
from numba import carray

from ...compiler.native.entry_point import EntryPoint
from ...compiler.native.jit import copy_into, inline_always, njit_internal
from ...compiler.native.plan import HEALTH_SIZE, REQUEST, RESULTS, plan_entry
from ...compiler.numerics.philox import STATES, uniform_at
from ..calls import OK, first_unknown, opened, reals_at, wanted_rows
from ..plan import PLAN
from .callbacks import CALLBACK_ARGUMENTS, PREDICTED, UPDATED, run_observed, searchsorted
from .weights import effective_number, normalise

LAST_EVENTS = {"predicted": int(PREDICTED), "filtered": int(UPDATED)}
"""The last event at a step that a moment includes."""

# Integers of the callbacks, then the steps of the rows. The last four are addresses of what a run
# writes. Reals of the states: mean, sd, draw, each (R, n), and effective number (R,).
_N_HEADER = 10
(
    _N, _MEMBERS, _ROWS, _LAST_EVENT, _SEED, _NEXT, _MEAN, _COV, _STATES, _WEIGHTS,
) = range(_N_HEADER)  # fmt: skip


@inline_always
def current_row(integers, event, k):
    """The row that step k has, -1 if none or if the event comes too late."""
    header = carray(integers, (_N_HEADER,))
    if event > header[_LAST_EVENT]:  # members before resampling say the same, more exactly
        return np.int64(-1)
    rows = carray(integers, (_N_HEADER + header[_ROWS],))[_N_HEADER:]
    row = header[_NEXT] = searchsorted(rows, k, header[_NEXT])
    return row if row < rows.size and rows[row] == k else np.int64(-1)


@njit_internal
def _header(call, rows):
    """The integers of a callback."""
    integers, to = np.empty(_N_HEADER + rows.size, np.int64), call.results
    integers[_N], integers[_MEMBERS] = call.plan[PLAN.n], call.plan[PLAN.n_members]
    integers[_ROWS], integers[_LAST_EVENT] = rows.size, call.plan[PLAN.last_event]
    integers[_SEED], integers[_NEXT] = call.request[REQUEST.draw_seed], 0
    integers[_MEAN], integers[_COV] = to[RESULTS.mean], to[RESULTS.cov]
    integers[_STATES], integers[_WEIGHTS] = to[RESULTS.members], to[RESULTS.weights]
    copy_into(integers[_N_HEADER:], rows)
    return integers


def _summarise(integers, reals, event, j, k, X, log_w, d, D, ancestors):
    header = carray(integers, (_N_HEADER,))
    n, N, n_rows = header[_N], header[_MEMBERS], header[_ROWS]
    row = current_row(integers, event, k)
    if row >= 0:
        members = carray(X, (n, N))
        w = finite_weights(members, carray(log_w, (N,)))
        out = carray(reals, ((3 * n + 1) * n_rows,))
        summarise_row(out, n_rows, row, members, w, header[_SEED], k)


def _store_members(integers, reals, event, j, k, X, log_w, d, D, ancestors):
    header = carray(integers, (_N_HEADER,))
    n, N = header[_N], header[_MEMBERS]
    row = current_row(integers, event, k)
    if row >= 0:
        members = carray(X, (n, N))
        w = finite_weights(members, carray(log_w, (N,)))
        mean, cov, stored, weights = _stored(header)
        for i in range(N):
            weights[row, i] = w[i]
            for a in range(n):
                stored[row, i, a] = members[a, i]
        if w.any():
            mean_and_cov(w, members, mean[row], cov[row])


@njit_internal
def _stored(header):
    """Mean, covariance, members and weights of a run, as arrays of the results."""
    n, N, R = header[_N], header[_MEMBERS], header[_ROWS]
    return (
        reals_at(header[_MEAN], (R, n)),
        reals_at(header[_COV], (R, n, n)),
        reals_at(header[_STATES], (R, N, n)),
        reals_at(header[_WEIGHTS], (R, N)),
    )


@njit_internal
def finite_weights(X, log_w):
    """Normalised weights of the members that are finite; all zero if none is."""
    log_w, w = log_w.copy(), np.zeros(log_w.size)
    for a in range(X.shape[0]):
        for i in range(w.size):
            if not np.isfinite(X[a, i]):
                log_w[i] = -np.inf
    normalise(log_w, w)
    return w


@njit_internal
def summarise_row(numbers, n_rows, row, X, w, draw_seed, place):
    """Write mean, deviation, a draw and the effective number of weighted members to their row.

    The draw is the one that falls to the uniform number of ``place``.
    """
    n = X.shape[0]
    out = numbers[: 3 * n * n_rows].reshape(3, n_rows, n)
    if not w.any():
        return
    _moments(w, X, out[0, row], out[1, row])
    chosen = choose(w, uniform_at(draw_seed, STATES, place, 0))
    for a in range(n):
        out[2, row, a] = X[a, chosen]
    numbers[3 * n * n_rows + row] = effective_number(w)


@njit_internal
def _moments(w, X, mean, sd):
    """Weighted mean and deviation of each row, the variance over 1 - sum w^2."""
    spread = 1.0 - 1.0 / effective_number(w)
    for a in range(X.shape[0]):
        mean[a] = 0.0
        for i in range(w.size):
            if w[i] > 0.0:
                mean[a] += w[i] * X[a, i]
        variance = 0.0
        for i in range(w.size):
            if w[i] > 0.0:
                variance += w[i] * (X[a, i] - mean[a]) ** 2
        sd[a] = math.sqrt(variance / spread) if spread > 0.0 else 0.0


@njit_internal
def mean_and_cov(w, X, mean, cov):
    """Weighted mean and covariance of the members, the latter over 1 - sum w^2 (Eq. 4.33)."""
    spread = 1.0 - 1.0 / effective_number(w)
    for a in range(X.shape[0]):
        mean[a] = 0.0
        for i in range(w.size):
            if w[i] > 0.0:
                mean[a] += w[i] * X[a, i]
        for b in range(a + 1):
            total = 0.0
            for i in range(w.size):
                if w[i] > 0.0:
                    total += w[i] * (X[a, i] - mean[a]) * (X[b, i] - mean[b])
            cov[a, b] = cov[b, a] = total / spread if spread > 0.0 else 0.0


@njit_internal
def choose(w, u):
    """The member in whose share of the whole weight a number of (0, 1) falls."""
    chosen, cumulative = 0, 0.0
    for i in range(w.size):
        if w[i] > 0.0:
            chosen = i
            cumulative += w[i]
            if u < cumulative:
                break
    return chosen


SUMMARISE = EntryPoint(_summarise, CALLBACK_ARGUMENTS, "summarise")
STORE_MEMBERS = EntryPoint(_store_members, CALLBACK_ARGUMENTS, "store_members")


@njit_internal
def forget_row(numbers, n, n_rows, row):
    """Leave a row unknown."""
    for place in range(3):
        for a in range(n):
            numbers[(place * n_rows + row) * n + a] = np.nan
    numbers[3 * n * n_rows + row] = np.nan


@njit_internal
def write_summaries(call, numbers, health, until):
    """Write what rows were summarised to as results; from the step ``until`` on all are unknown."""
    rows, n, to = wanted_rows(call), call.results[RESULTS.n_states], call.results
    for row in range(rows.size):
        if rows[row] >= until:
            forget_row(numbers, n, rows.size, row)
    size = n * rows.size
    copy_into(reals_at(to[RESULTS.mean], (size,)), numbers[:size])
    copy_into(reals_at(to[RESULTS.sd], (size,)), numbers[size : 2 * size])
    copy_into(reals_at(to[RESULTS.drawn], (size,)), numbers[2 * size : 3 * size])
    copy_into(reals_at(to[RESULTS.n_effective_wanted], (rows.size,)), numbers[3 * size :])
    copy_into(reals_at(to[RESULTS.health], (HEALTH_SIZE,)), health)


def _states(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    if status != OK or call.request[REQUEST.sizes_only]:
        return status
    rows, n = wanted_rows(call), call.plan[PLAN.n]
    reals = np.full((3 * n + 1) * rows.size, np.nan)
    integers = _header(call, rows)
    status, _, health = run_observed(call, plan, record, integers, reals)
    write_summaries(call, reals, health, first_unknown(call, health))
    return status


def _run(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    if status != OK or call.request[REQUEST.sizes_only]:
        return status
    rows, to, integers = wanted_rows(call), call.results, _header(call, wanted_rows(call))
    mean, cov, members, weights = _stored(integers)
    mean[:], cov[:], members[:], weights[:] = np.nan, np.nan, np.nan, np.nan
    status, terms, health = run_observed(call, plan, record, integers, np.empty(0))
    until = first_unknown(call, health)
    for row in range(rows.size):
        if rows[row] >= until:
            mean[row], cov[row], members[row], weights[row] = np.nan, np.nan, np.nan, np.nan
    copy_into(reals_at(to[RESULTS.terms], (terms.size,)), terms)
    copy_into(reals_at(to[RESULTS.health], (HEALTH_SIZE,)), health)
    return status


MEMBER_STATES = plan_entry(_states, "ensemble_states")
"""Predicted or filtered states, in one pass."""

MEMBER_RUN = plan_entry(_run, "ensemble_run")
"""One run that keeps all members at some steps."""
