"""One run of an ensemble filter with all that it knew: its weighted members, and their moments."""

from typing import Any

import numpy as np
from numba import carray

from pymc_statespace_filters.compiler.native.cache_key import digest
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint, address_of
from pymc_statespace_filters.compiler.native.jit import keep_alive, njit_contract
from pymc_statespace_filters.filters.ensemble.callbacks import (
    CALLBACK_ARGUMENTS,
    UPDATED,
    searchsorted,
)
from pymc_statespace_filters.filters.ensemble.summaries import finite_weights
from pymc_statespace_filters.filters.ensemble.weights import effective_number
from pymc_statespace_filters.filters.outcomes import NONE

# The witness's whole numbers: states, members, rows, next row; then the steps of the rows. Its real
# ones: mean (R, n), covariance (R, n, n), members (R, N, n), weights (R, N).
_N_COUNTS = 4
_N, _MEMBERS, _ROWS, _NEXT = range(_N_COUNTS)


def _note_down(counts, numbers, event, j, k, members, log_weights, d, simulated, ancestors):
    of = carray(counts, (_N_COUNTS,))
    n, N, R = of[_N], of[_MEMBERS], of[_ROWS]
    if event > UPDATED:  # members before resampling say the same, more exactly
        return
    rows = carray(counts, (_N_COUNTS + R,))[_N_COUNTS:]
    row = of[_NEXT] = searchsorted(k, rows, of[_NEXT])
    if row == R or rows[row] != k:
        return
    X = carray(members, (n, N))
    w = finite_weights(X, carray(log_weights, (N,)))
    mean, cov, kept, weights = _parts(carray(numbers, (_size(n, N, R),)), n, N, R)
    for i in range(N):
        weights[row, i] = w[i]
        for a in range(n):
            kept[row, i, a] = X[a, i]
    if w.any():
        _moments(w, X, mean[row], cov[row])


@njit_contract
def _size(n, N, R):
    return R * (n + n * n + N * n + N)


@njit_contract
def _parts(numbers, n, N, R):
    """Mean, covariance, members and weights, which lie one after the other."""
    of_cov = R * n
    of_members = of_cov + R * n * n
    of_weights = of_members + R * N * n
    return (
        numbers[:of_cov].reshape(R, n),
        numbers[of_cov:of_members].reshape(R, n, n),
        numbers[of_members:of_weights].reshape(R, N, n),
        numbers[of_weights:].reshape(R, N),
    )


@njit_contract
def _moments(w, X, mean, cov):
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


NOTE_DOWN = EntryPoint(
    _note_down, CALLBACK_ARGUMENTS, "note_down_members", digest("note_down_members")
)


def members_kernel(evaluate: Any, n: int, n_members: int) -> Any:
    """The function (theta, steps, observed, inputs, t0, seed, rows) -> a run.

    Parameters
    ----------
    evaluate : njit function
        Of a filter and a system, see `EnsembleFilter.with_callback`.
    n, n_members : int
        Numbers of states and members.
    """
    NOTE_DOWN.compile()
    witness, N = NOTE_DOWN.symbol, n_members

    @njit_contract
    def run(theta, steps, observed, inputs, t0, seed, rows):
        R = rows.size
        counts, numbers = np.empty(_N_COUNTS + R, np.int64), np.full(_size(n, N, R), np.nan)
        counts[_N], counts[_MEMBERS], counts[_ROWS], counts[_NEXT] = n, N, R, 0
        counts[_N_COUNTS:] = rows
        watch = (address_of(witness), np.int64(counts.ctypes.data), np.int64(numbers.ctypes.data))
        terms, health = evaluate(theta, steps, observed, inputs, t0, (seed, np.empty(0)), watch)
        keep_alive(counts)
        mean, cov, members, weights = _parts(numbers, n, N, R)
        if health[1] != NONE:
            for row in range(R):
                if rows[row] >= steps[int(health[2])]:
                    mean[row], cov[row], members[row], weights[row] = np.nan, np.nan, np.nan, np.nan
        # Members and weights share memory, of which there may be gigabytes.
        return terms, health, mean.copy(), cov.copy(), members, weights

    return run
