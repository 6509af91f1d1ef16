"""States that a filter with members reports, written by a callback: at draws, and of whole runs."""

import math

import numpy as np
from numba import carray

from ...compiler.native.entry_point import EntryPoint, pointer
from ...compiler.native.jit import copy_into, inline_always, njit_internal
from ...compiler.native.plan import HEALTH_SIZE, N_RESULTS, REQUEST, RESULTS, plan_entry
from ...compiler.numerics.philox import STATES, uniform_at
from ..calls import OK, first_unknown, opened, reals_at, wanted_rows
from ..plan import PLAN, settings_of
from .callbacks import CALLBACK_ARGUMENTS, PREDICTED, UPDATED, run_observed, searchsorted
from .evaluation import layout_of
from .part_moments import choose, draw_of_mixture, mixture_moments
from .weights import effective_number, normalise

LAST_EVENTS = {"predicted": int(PREDICTED), "filtered": int(UPDATED)}
"""The last event at a step that a moment includes."""

_OF_ROWS = (
    RESULTS.mean, RESULTS.sd, RESULTS.cov, RESULTS.drawn, RESULTS.n_effective_wanted,
    RESULTS.members, RESULTS.weights,
)  # fmt: skip

# Integers of the callback; then the steps of the rows, and the order of the states.
_N_HEADER = 9
(
    _PART_ROWS, _MEMBERS, _ROWS, _LAST_EVENT, _SEED, _NEXT, _EXACT, _N, _RESULTS
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
def _header(call, layout):
    """The integers of the callback."""
    rows, order, plan = wanted_rows(call), layout.order, call.plan
    integers = np.empty(_N_HEADER + rows.size + order.size, np.int64)
    integers[_PART_ROWS], integers[_MEMBERS] = layout.rows, int(settings_of(plan)[0])
    integers[_ROWS], integers[_LAST_EVENT] = rows.size, plan[PLAN.last_event]
    integers[_SEED], integers[_NEXT] = call.request[REQUEST.draw_seed], 0
    integers[_EXACT], integers[_N] = layout.n_exact, order.size
    integers[_RESULTS] = call.results.ctypes.data
    copy_into(integers[_N_HEADER : _N_HEADER + rows.size], rows)
    copy_into(integers[_N_HEADER + rows.size :], order)
    return integers


def _summarise(integers, reals, event, j, k, X, log_w, d, D, ancestors):
    row = current_row(integers, event, k)
    if row >= 0:
        header = carray(integers, (_N_HEADER,))
        parts = carray(X, (header[_PART_ROWS], header[_MEMBERS]))
        w = finite_weights(parts, carray(log_w, (header[_MEMBERS],)))
        first = _N_HEADER + header[_ROWS]
        order = carray(integers, (first + header[_N],))[first:]
        to, n_effective = carray(pointer(header[_RESULTS]), (N_RESULTS,), np.int64), np.inf
        if w.size > 1 and w.any():
            n_effective = effective_number(w)
        write_row(to, row, k, header[_EXACT], order, parts, w, n_effective, header[_SEED])


@njit_internal
def write_row(to, row, k, n_exact, order, parts, w, n_effective, seed):
    """Write what is wanted of a row, from weighted parts; those without weight have no moments.

    Fewer effective parts leave the variance between them too small, by a factor that is known.
    """
    n, N, R = order.size, w.size, to[RESULTS.n_wanted]
    if to[RESULTS.members] != 0 and to[RESULTS.n_members] != 0:  # a part that is alone is none
        states = reals_at(to[RESULTS.members], (R, N, n))[row]
        copy_into(reals_at(to[RESULTS.weights], (R, N))[row], w)
        for i in range(N):
            for a in range(n):
                states[i, a] = parts[order[a], i]
    if not w.any():
        return
    mean, cov = reals_at(to[RESULTS.mean], (R, n))[row], np.empty((n, n))
    mixture_moments(w, parts, n_exact, order, 1.0 - 1.0 / n_effective, mean, cov)
    if to[RESULTS.cov] != 0:
        copy_into(reals_at(to[RESULTS.cov], (R, n * n))[row], cov.reshape(n * n))
    if to[RESULTS.drawn] != 0:
        sd = reals_at(to[RESULTS.sd], (R, n))[row]
        for a in range(n):
            sd[a] = math.sqrt(max(cov[a, a], 0.0))
        drawn = reals_at(to[RESULTS.drawn], (R, n))[row]
        draw_of_mixture(w, parts, n_exact, order, seed, k, drawn)
        reals_at(to[RESULTS.n_effective_wanted], (R,))[row] = n_effective


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
def places_of(to, n, row):
    """Where mean, deviation, a draw (n,) and the effective number (1,) of a row go."""
    R = to[RESULTS.n_wanted]
    mean, sd = reals_at(to[RESULTS.mean], (R, n))[row], reals_at(to[RESULTS.sd], (R, n))[row]
    n_effective = reals_at(to[RESULTS.n_effective_wanted], (R,))[row : row + 1]
    return mean, sd, reals_at(to[RESULTS.drawn], (R, n))[row], n_effective


@njit_internal
def n_distinct(indices, n):
    """How many of the indices below n occur; numba's sort takes a second of compilation."""
    is_met, found = np.zeros(n, np.bool_), 0
    for i in indices:
        found += not is_met[i]
        is_met[i] = True
    return found


@njit_internal
def summarise_row(to, row, X, w, draw_seed):
    """Write mean, deviation and a draw of weighted members; one place of the seed for all rows."""
    if not w.any():
        return
    mean, sd, drawn, _ = places_of(to, X.shape[0], row)
    _moments(w, X, mean, sd)
    chosen = choose(w, uniform_at(draw_seed, STATES, 0, 0))
    for a in range(X.shape[0]):
        drawn[a] = X[a, chosen]


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


SUMMARISE = EntryPoint(_summarise, CALLBACK_ARGUMENTS, "summarise")


@njit_internal
def forget(call, n, first):
    """Leave rows from this one on unknown."""
    to, R, N = call.results, wanted_rows(call).size, call.plan[PLAN.n_members]
    widths = (n, n, n * n, n, 1, N * n, N)
    for i in range(len(_OF_ROWS)):
        address = to[_OF_ROWS[i]]
        if address != 0:
            reals_at(address, (R * widths[i],))[first * widths[i] :] = np.nan


def _states(plan, record, request, results):
    """Moments, and draws or the members of a run, whichever are wanted."""
    status, call = opened(plan, record, request, results)
    if status != OK:
        return status
    layout, _ = layout_of(call.plan)
    n, to = layout.order.size, call.results
    to[RESULTS.n_states] = n
    if call.request[REQUEST.sizes_only]:
        return status
    forget(call, n, 0)
    status, terms, health = run_observed(call, plan, record, _header(call, layout), np.empty(0))
    forget(call, n, searchsorted(wanted_rows(call), first_unknown(call, health), 0))
    if to[RESULTS.terms] != 0:
        copy_into(reals_at(to[RESULTS.terms], (terms.size,)), terms)
    copy_into(reals_at(to[RESULTS.health], (HEALTH_SIZE,)), health)
    return status


STATES_OF_PARTS = plan_entry(_states, "states_of_parts")
"""Predicted or filtered states, and whole runs, in one pass."""
