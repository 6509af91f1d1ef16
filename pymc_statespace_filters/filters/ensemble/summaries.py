"""States of an ensemble filter: moments and a draw of the weighted members, as they pass by."""

import math
from typing import Any

import numpy as np
from numba import carray

from pymc_statespace_filters.compiler.native.cache_key import digest
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint, address_of
from pymc_statespace_filters.compiler.native.jit import keep_alive, njit_contract
from pymc_statespace_filters.compiler.numerics.philox import STATES, uniform_at
from pymc_statespace_filters.filters.ensemble.callbacks import (
    CALLBACK_ARGUMENTS,
    FORECAST,
    UPDATED,
    searchsorted,
)
from pymc_statespace_filters.filters.ensemble.weights import effective_number, normalise
from pymc_statespace_filters.filters.outcomes import NONE

# The last event at a step that a moment knows of.
_LAST_EVENT = {"predicted": int(FORECAST), "filtered": int(UPDATED)}

# The witness's whole numbers: states, members, rows, last event, seed of the draws, next row; then
# the steps of the rows. Its real ones: mean, sd, draw, each (rows, n), and effective number (rows).
_N_COUNTS = 6
_N, _MEMBERS, _ROWS, _LAST, _SEED, _NEXT = range(_N_COUNTS)


def _summarise(counts, numbers, event, j, k, members, log_weights, d, simulated, ancestors):
    of = carray(counts, (_N_COUNTS,))
    n, N, n_rows = of[_N], of[_MEMBERS], of[_ROWS]
    if event > of[_LAST]:  # members before resampling say the same, more exactly
        return
    rows = carray(counts, (_N_COUNTS + n_rows,))[_N_COUNTS:]
    row = of[_NEXT] = searchsorted(k, rows, of[_NEXT])
    if row == n_rows or rows[row] != k:
        return
    X = carray(members, (n, N))
    w = finite_weights(X, carray(log_weights, (N,)))
    summarise_row(carray(numbers, ((3 * n + 1) * n_rows,)), n_rows, row, X, w, of[_SEED], k)


@njit_contract
def finite_weights(X, log_w):
    """Normalised weights of the members that are finite; all zero if none is."""
    log_w, w = log_w.copy(), np.zeros(log_w.size)
    for a in range(X.shape[0]):
        for i in range(w.size):
            if not np.isfinite(X[a, i]):
                log_w[i] = -np.inf
    normalise(log_w, w)
    return w


@njit_contract
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


@njit_contract
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


@njit_contract
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


def summary_kernel(evaluate: Any, n: int, n_members: int, moment: str) -> Any:
    """The function (theta, steps, observed, inputs, t0, seed, rows, draw_seed) -> states.

    Parameters
    ----------
    evaluate : njit function
        Of a filter and a system, see `EnsembleFilter.with_callback`.
    n, n_members : int
        Numbers of states and members.
    moment : {"predicted", "filtered"}
    """
    SUMMARISE.compile()
    witness, last_event = SUMMARISE.symbol, _LAST_EVENT[moment]

    @njit_contract
    def run(theta, steps, observed, inputs, t0, seed, rows, draw_seed):
        R = rows.size
        counts, numbers = np.empty(_N_COUNTS + R, np.int64), np.full((3 * n + 1) * R, np.nan)
        counts[_N], counts[_MEMBERS], counts[_ROWS] = n, n_members, R
        counts[_LAST], counts[_SEED], counts[_NEXT] = last_event, draw_seed, 0
        counts[_N_COUNTS:] = rows
        watch = (address_of(witness), np.int64(counts.ctypes.data), np.int64(numbers.ctypes.data))
        _, health = evaluate(theta, steps, observed, inputs, t0, (seed, np.empty(0)), watch)
        keep_alive(counts)
        if health[1] != NONE:
            for row in range(R):
                if rows[row] >= steps[int(health[2])]:
                    forget_row(numbers, n, R, row)
        return results(numbers, n, R, health)

    return run


@njit_contract
def forget_row(numbers, n, n_rows, row):
    """Leave a row unknown."""
    for place in range(3):
        for a in range(n):
            numbers[(place * n_rows + row) * n + a] = np.nan
    numbers[3 * n * n_rows + row] = np.nan


@njit_contract
def results(numbers, n, n_rows, health):
    """What rows were summarised to, as the function of the states gives it."""
    moments = numbers[: 3 * n * n_rows].reshape(3, n_rows, n)
    n_effective = numbers[3 * n * n_rows : (3 * n + 1) * n_rows].copy()
    return moments[0].copy(), moments[1].copy(), moments[2].copy(), n_effective, health
