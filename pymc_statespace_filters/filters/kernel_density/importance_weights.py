"""Importance weights of an ensemble Kalman proposal, by kernel densities (thesis, Eqs. 4.36-4.39).

The forecast particles, moved by the Kalman update, are a sample of the proposal. The density of the
forecast (the prior) and that of the proposal are estimated from the particles themselves.
"""

import math
from typing import NamedTuple

import numpy as np

from pymc_statespace_filters.compiler.native.jit import inline_always, njit_contract
from pymc_statespace_filters.filters.ensemble.kalman_update import equal_weights
from pymc_statespace_filters.filters.ensemble.reductions import (
    exchange,
    means,
    sum_members,
    sum_products,
)
from pymc_statespace_filters.filters.ensemble.system_table import log_density
from pymc_statespace_filters.filters.kernel_density.density import (
    density_workspace,
    kernel_workspace,
    log_kernel_density,
    scott_bandwidth,
)


class Forecast(NamedTuple):
    """Forecast of all ranks: number of finite particles, N_eff, 1 - sum w^2, log E p(d | x)."""

    n_alive: float
    n_effective: float
    spread: float
    log_mean: float


class Scratch(NamedTuple):
    """Moments of the forecast, and scratch of the densities of Eq. 4.36."""

    moments: tuple
    w_equal: np.ndarray
    log_prior: np.ndarray
    log_proposal: np.ndarray
    density: tuple


@inline_always
def importance_workspace(system, local):
    """Scratch of one update."""
    n, p, N = system.n, system.p, local.size
    moments = (np.empty(n), np.empty(p), np.empty((n, p)), np.empty((p, p)))
    density = density_workspace(local, system.free.size)
    return Scratch(moments, np.empty(N), np.empty(N), np.empty(N), density)


@inline_always
def reweight(system, k, t, d, members, forecast, local, scratch, keeps_previous):
    """Write the unnormalised log-weights of X to log_w and log p(d | x^a) to log_p.

    ``keeps_previous`` keeps the factor w_{d(j)-1,i} of Eq. 4.36. Returns False, with log_w
    unchanged, if proposal and forecast do not spread in the same directions.
    """
    X, _, X_f, w, log_w, log_p, alive = members
    _, w_equal, log_prior, log_proposal, density = scratch
    free, n, n_alive = system.free, system.n, forecast.n_alive
    kernel_f, kernel_a = kernel_workspace(n, free.size), kernel_workspace(n, free.size)
    equal_weights(alive, n_alive, w_equal)
    if not _set_bandwidths(members, w_equal, forecast, free, local, scratch, kernel_f, kernel_a):
        return False
    log_density(system, k, t, d, X, log_p)
    log_kernel_density(local, w, X_f, X, free, kernel_f, density, log_prior)
    log_kernel_density(local, w_equal, X, X, free, kernel_a, density, log_proposal)
    for i in range(w.size):
        previous = log_w[i] if keeps_previous else -math.log(n_alive)
        log_weight = previous + log_p[i] + (log_prior[i] - log_proposal[i])
        log_w[i] = log_weight if alive[i] else -np.inf
    return True


@inline_always
def _set_bandwidths(members, w_equal, forecast, free, local, scratch, kernel_f, kernel_a):
    X, _, X_f, w, _, _, _ = members
    n, n_alive = X.shape[0], forecast.n_alive
    sum_members(w_equal, X, local, 0)
    exchange(local, n)
    means(local, 0, 1.0, kernel_a.mean)
    for a in range(n):
        kernel_f.mean[a] = scratch.moments[0][a]
    sum_products(w_equal, X, kernel_a.mean, X, kernel_a.mean, local, 0)
    sum_products(w, X_f, kernel_f.mean, X_f, kernel_f.mean, local, n * n)
    exchange(local, 2 * n * n)
    return (
        scott_bandwidth(local, 0, 1.0 - 1.0 / n_alive, n_alive, free, kernel_a)  # Eq. 4.38
        and scott_bandwidth(local, n * n, forecast.spread, forecast.n_effective, free, kernel_f)
        and _agree(kernel_a.active, kernel_f.active)
    )


@njit_contract
def _agree(spreads_a, spreads_f):
    """Whether two ensembles spread in the same directions."""
    for a in range(spreads_a.size):
        if spreads_a[a] != spreads_f[a]:
            return False
    return True
