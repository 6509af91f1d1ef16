"""Callbacks that summarise or store weighted members: filtered states, and whole runs."""

import math

import numpy as np
from numba import carray

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction
from pymc_statespace_filters.compiler.native.cache_key import digest, key_of
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint, address_of
from pymc_statespace_filters.compiler.native.jit import (
    inline_always,
    keep_alive,
    njit_callable,
    njit_internal,
)
from pymc_statespace_filters.compiler.numerics.philox import STATES, uniform_at
from pymc_statespace_filters.filters.ensemble.callbacks import (
    CALLBACK_ARGUMENTS,
    PREDICTED,
    UPDATED,
    searchsorted,
)
from pymc_statespace_filters.filters.ensemble.weights import effective_number, normalise
from pymc_statespace_filters.filters.outcomes import NONE
from pymc_statespace_filters.filters.protocol import RunFunction, StatesFunction

# The last event at a step that a moment includes.
_LAST_EVENTS = {"predicted": int(PREDICTED), "filtered": int(UPDATED)}

# Integers of the callbacks, then the steps of the rows. Reals of the states: mean, sd, draw, each
# (R, n), and effective number (R,). Reals of a run: mean (R, n), covariance (R, n, n), members
# (R, N, n), weights (R, N).
_N_HEADER = 6
_N, _MEMBERS, _ROWS, _LAST_EVENT, _SEED, _NEXT = range(_N_HEADER)


@inline_always
def _current_row(integers, event, k):
    """The row that step k has, -1 if none or if the event comes too late."""
    header = carray(integers, (_N_HEADER,))
    if event > header[_LAST_EVENT]:  # members before resampling say the same, more exactly
        return np.int64(-1)
    rows = carray(integers, (_N_HEADER + header[_ROWS],))[_N_HEADER:]
    row = header[_NEXT] = searchsorted(rows, k, header[_NEXT])
    return row if row < rows.size and rows[row] == k else np.int64(-1)


@njit_internal
def _header(n, n_members, rows, last_event, draw_seed):
    integers = np.empty(_N_HEADER + rows.size, np.int64)
    integers[_N], integers[_MEMBERS], integers[_ROWS] = n, n_members, rows.size
    integers[_LAST_EVENT], integers[_SEED], integers[_NEXT] = last_event, draw_seed, 0
    integers[_N_HEADER:] = rows
    return integers


def _summarise(integers, reals, event, j, k, X, log_w, d, D, ancestors):
    header = carray(integers, (_N_HEADER,))
    n, N, n_rows = header[_N], header[_MEMBERS], header[_ROWS]
    row = _current_row(integers, event, k)
    if row >= 0:
        members = carray(X, (n, N))
        w = finite_weights(members, carray(log_w, (N,)))
        out = carray(reals, ((3 * n + 1) * n_rows,))
        summarise_row(out, n_rows, row, members, w, header[_SEED], k)


def _store_members(integers, reals, event, j, k, X, log_w, d, D, ancestors):
    header = carray(integers, (_N_HEADER,))
    n, N, n_rows = header[_N], header[_MEMBERS], header[_ROWS]
    row = _current_row(integers, event, k)
    if row >= 0:
        members = carray(X, (n, N))
        w = finite_weights(members, carray(log_w, (N,)))
        parts = _parts(carray(reals, (_run_size(n, N, n_rows),)), n, N, n_rows)
        mean, cov, stored, weights = parts
        for i in range(N):
            weights[row, i] = w[i]
            for a in range(n):
                stored[row, i, a] = members[a, i]
        if w.any():
            mean_and_cov(w, members, mean[row], cov[row])


@njit_internal
def _run_size(n, N, R):
    return R * (n + n * n + N * n + N)


@njit_internal
def _parts(reals, n, N, R):
    """Mean, covariance, members and weights, which lie one after the other."""
    cov = R * n
    members = cov + R * n * n
    weights = members + R * N * n
    return (
        reals[:cov].reshape(R, n),
        reals[cov:members].reshape(R, n, n),
        reals[members:weights].reshape(R, N, n),
        reals[weights:].reshape(R, N),
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


SUMMARISE = EntryPoint(_summarise, CALLBACK_ARGUMENTS, "summarise", digest("summarise"))
STORE_MEMBERS = EntryPoint(
    _store_members, CALLBACK_ARGUMENTS, "store_members", digest("store_members")
)


def states_function(
    evaluate: CompiledFunction, n: int, n_members: int, moment: str
) -> CompiledFunction[StatesFunction]:
    """Compile "predicted" or "filtered" states of a likelihood with callback, in one pass."""
    SUMMARISE.compile()
    callback, last_event, likelihood = SUMMARISE.symbol, _LAST_EVENTS[moment], evaluate.function

    @njit_callable
    def run(theta, steps, observed, inputs, t0, seed, rows, draw_seed):
        R, reals = rows.size, np.full((3 * n + 1) * rows.size, np.nan)
        integers = _header(n, n_members, rows, last_event, draw_seed)
        to = (address_of(callback), np.int64(integers.ctypes.data), np.int64(reals.ctypes.data))
        _, health = likelihood(theta, steps, observed, inputs, t0, (seed, np.empty(0)), to)
        keep_alive(integers)
        if health[1] != NONE:
            for row in range(R):
                if rows[row] >= steps[int(health[2])]:
                    forget_row(reals, n, R, row)
        return results(reals, n, R, health)

    return CompiledFunction(run, key_of(f"{moment} states", evaluate.key, SUMMARISE.key))


def run_function(
    evaluate: CompiledFunction, n: int, n_members: int
) -> CompiledFunction[RunFunction]:
    """Compile one run of a likelihood with callback that stores all members at some steps."""
    STORE_MEMBERS.compile()
    callback, last_event, N = STORE_MEMBERS.symbol, int(UPDATED), n_members
    likelihood = evaluate.function

    @njit_callable
    def run(theta, steps, observed, inputs, t0, seed, rows):
        R, reals = rows.size, np.full(_run_size(n, N, rows.size), np.nan)
        integers = _header(n, N, rows, last_event, 0)
        to = (address_of(callback), np.int64(integers.ctypes.data), np.int64(reals.ctypes.data))
        terms, health = likelihood(theta, steps, observed, inputs, t0, (seed, np.empty(0)), to)
        keep_alive(integers)
        mean, cov, members, weights = _parts(reals, n, N, R)
        if health[1] != NONE:
            for row in range(R):
                if rows[row] >= steps[int(health[2])]:
                    mean[row], cov[row], members[row], weights[row] = np.nan, np.nan, np.nan, np.nan
        # Members and weights share memory, of which there may be gigabytes.
        return terms, health, mean.copy(), cov.copy(), members, weights

    return CompiledFunction(run, key_of("run", evaluate.key, STORE_MEMBERS.key))


@njit_internal
def forget_row(numbers, n, n_rows, row):
    """Leave a row unknown."""
    for place in range(3):
        for a in range(n):
            numbers[(place * n_rows + row) * n + a] = np.nan
    numbers[3 * n * n_rows + row] = np.nan


@njit_internal
def results(numbers, n, n_rows, health):
    """What rows were summarised to, as the function of the states gives it."""
    moments = numbers[: 3 * n * n_rows].reshape(3, n_rows, n)
    n_effective = numbers[3 * n * n_rows : (3 * n + 1) * n_rows].copy()
    return moments[0].copy(), moments[1].copy(), moments[2].copy(), n_effective, health
