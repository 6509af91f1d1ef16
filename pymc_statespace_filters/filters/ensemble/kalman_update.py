"""The Kalman update of an ensemble: moments, gain and analysis, shared by EnKF and PFEnKF.

Members are columns: X (states, members), D (observables, members). Weights are normalised; with
equal weights 1/N the weighted covariances of Eqs. 4.32-4.33 are those of Eqs. 4.18-4.19.
"""

from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.numerics.small_cholesky import cholesky, solve_lower, solve_lower_transposed
from ...errors import ModelError
from ..protocol import System
from .reductions import (
    FIRST_ROW,
    allgather_sums,
    sum_members,
    sum_products,
    sum_spread,
    sum_values,
    total,
)
from .weights import total_weight, weigh


@njit_internal
def mark_finite(X, D, alive):
    """Set ``alive`` where states and simulated observations are all finite."""
    for i in range(alive.size):
        alive[i] = True
    for A in (X, D):
        for a in range(A.shape[0]):
            for i in range(alive.size):
                alive[i] &= np.isfinite(A[a, i])


@njit_internal
def copy_members(X, out):
    """Copy X into out, by loops: a slice assignment brings its error message into every filter."""
    for a in range(X.shape[0]):
        for i in range(X.shape[1]):
            out[a, i] = X[a, i]


@njit_internal
def equal_weights(alive, count, w):
    """Weight 1/count for the members alive, zero for the others."""
    for i in range(w.size):
        w[i] = 1.0 / count if alive[i] else 0.0


class Moments(NamedTuple):
    """Moments of a forecast: of states, simulated observations, and both (Eqs. 4.16-4.19).

    `forecast_covariances` leaves the Cholesky factor in ``P_dd``, `kalman_update` the gain in
    ``P_xd``.
    """

    x_mean: np.ndarray
    d_mean: np.ndarray
    P_xd: np.ndarray
    P_dd: np.ndarray


@njit_internal
def moments_workspace(n, p):
    """Room for the moments of n states and p observables."""
    return Moments(np.empty(n), np.empty(p), np.empty((n, p)), np.empty((p, p)))


class Forecast(NamedTuple):
    """Sums over all members of a forecast: how many are alive, 1 - sum w^2, and a log of a sum.

    ``log_sum`` is the log of the sum of the weights that the caller gave as ``log_terms``,
    ``n_effective`` their effective number.
    """

    n_alive: float
    spread: float
    log_sum: float
    n_effective: float


@njit_internal
def forecast_means(members, log_terms, terms, has_terms, local, moments, is_normalised):
    """Means of states and simulated observations (Eqs. 4.16, 4.30-4.31), in one allgather.

    Unless the weights w are normalised, they are 1 for members that are alive and 0 for others.
    ``has_terms`` tells whether to sum ``log_terms`` too.
    """
    n, p = moments.P_xd.shape
    of_alive, of_spread, of_x = FIRST_ROW, FIRST_ROW + 1, FIRST_ROW + 2
    of_d, of_terms = of_x + n, of_x + n + p
    sum_values(members.alive, local, of_alive)
    sum_spread(members.w, local, of_spread)
    sum_members(members.w, members.X, local, of_x)
    sum_members(members.w, members.D, local, of_d)
    if has_terms:
        weigh(log_terms, terms, local, of_terms)
    allgather_sums(local, of_terms + 3 * has_terms)
    n_alive, spread = total(local, of_alive), total(local, of_spread)
    weight = 1.0 if is_normalised else n_alive
    for a in range(n):
        moments.x_mean[a] = total(local, of_x + a) / weight
    for b in range(p):
        moments.d_mean[b] = total(local, of_d + b) / weight
    log_sum, n_effective = total_weight(local, of_terms) if has_terms else (0.0, 0.0)
    return Forecast(n_alive, spread, log_sum, n_effective)


@njit_internal
def forecast_covariances(members, d, divisor, local, moments):
    """Covariances of states and simulated observations over ``divisor``, in one allgather.

    (Eqs. 4.17-4.19, 4.32-4.33.) A missing component of d gets a row and column of the identity in
    P_dd and of zero in P_xd, so that it moves nothing. Returns False if P_dd is not positive
    definite.
    """
    w, X, D, P_xd, P_dd = members.w, members.X, members.D, moments.P_xd, moments.P_dd
    n, p = P_xd.shape
    sum_products(w, X, moments.x_mean, D, moments.d_mean, local, FIRST_ROW)
    sum_products(w, D, moments.d_mean, D, moments.d_mean, local, n * p)
    allgather_sums(local, (n + p) * p)
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


@njit_internal
def kalman_update(d, D, alive, free, moments, X):
    """x^a_i = x^f_i + K (d - d_i) with K = P_xd P_dd^-1 (Eqs. 4.20-4.21, 4.34-4.35), in place.

    Only free states are moved.
    """
    K, P_dd_chol = moments.P_xd, moments.P_dd
    for a in free:
        solve_lower(P_dd_chol, K[a])
        solve_lower_transposed(P_dd_chol, K[a])
        for b in range(d.size):
            if np.isnan(d[b]):
                continue
            for i in range(alive.size):
                step = K[a, b] * (d[b] - D[b, i])
                X[a, i] += step if alive[i] else 0.0


def check_simulated_observations(name: str, system: System) -> None:
    """Raise unless an observation can be simulated for a Kalman gain."""
    if system.model.is_censored:
        raise ModelError(
            f"{name} updates members by a Kalman gain and so needs measured values, got censored"
        )
    if not system.gaussian_observation:
        raise ModelError(
            f"{name} updates members by a Kalman gain and so needs an observation function with "
            f"Gaussian noise, got observation_dist or observation_logp"
        )
