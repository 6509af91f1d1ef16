"""The Kalman update of an ensemble: moments, gain and nudge, shared by EnKF and PFEnKF.

Members are columns: X (states, members), D (observables, members). Weights are normalised; with
equal weights 1/N the weighted covariances of Eqs. 4.32-4.33 are those of Eqs. 4.18-4.19.
"""

import numpy as np

from pymc_statespace_filters.compiler.native.jit import njit_contract
from pymc_statespace_filters.compiler.numerics.small_cholesky import (
    cholesky,
    solve_lower,
    solve_lower_transposed,
)
from pymc_statespace_filters.filters.ensemble.reductions import exchange, sum_products, total


@njit_contract
def mark_finite(X, D, alive):
    """Set ``alive`` where states and simulated observations are all finite."""
    for i in range(alive.size):
        alive[i] = True
    for A in (X, D):
        for a in range(A.shape[0]):
            for i in range(alive.size):
                alive[i] &= np.isfinite(A[a, i])


@njit_contract
def copy_members(X, out):
    """Copy X into out, by loops: a slice assignment brings its error message into every filter."""
    for a in range(X.shape[0]):
        for i in range(X.shape[1]):
            out[a, i] = X[a, i]


@njit_contract
def equal_weights(alive, count, w):
    """Weight 1/count for the members alive, zero for the others."""
    for i in range(w.size):
        w[i] = 1.0 / count if alive[i] else 0.0


@njit_contract
def forecast_moments(w, X, D, d, divisor, local, moments):
    """Covariances of states and simulated observations, whose means are given (Eqs. 4.16-4.19).

    They are sums with weights w over ``divisor``. P_dd is left as its Cholesky factor.

    A missing component of d gets a row and column of the identity in P_dd and of zero in P_xd, so
    that it moves nothing. Returns False if P_dd is not positive definite.
    """
    x_mean, d_mean, P_xd, P_dd = moments
    n, p = P_xd.shape
    sum_products(w, X, x_mean, D, d_mean, local, 0)
    sum_products(w, D, d_mean, D, d_mean, local, n * p)
    exchange(local, (n + p) * p)
    for b in range(p):
        for a in range(n):
            P_xd[a, b] = total(local, a * p + b) / divisor
        for a in range(p):
            P_dd[a, b] = total(local, (n + a) * p + b) / divisor
    for b in range(p):
        if np.isnan(d[b]):
            for a in range(n):
                P_xd[a, b] = 0.0
            for a in range(p):
                P_dd[a, b] = P_dd[b, a] = 0.0
            P_dd[b, b] = 1.0
    return cholesky(P_dd)


@njit_contract
def kalman_update(d, D, alive, free, moments, X):
    """x^a_i = x^f_i + K (d - d_i) with K = P_xd P_dd^-1 (Eqs. 4.20-4.21, 4.34-4.35), in place.

    Only free states are moved. P_xd becomes the gain.
    """
    _, _, K, P_dd_chol = moments
    for a in free:
        solve_lower(P_dd_chol, K[a])
        solve_lower_transposed(P_dd_chol, K[a])
        for b in range(d.size):
            if np.isnan(d[b]):
                continue
            for i in range(alive.size):
                step = K[a, b] * (d[b] - D[b, i])
                X[a, i] += step if alive[i] else 0.0
