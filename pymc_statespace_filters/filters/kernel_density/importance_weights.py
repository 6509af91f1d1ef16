"""Importance weights of an ensemble Kalman proposal, by kernel densities (thesis, Eqs. 4.36-4.39).

The forecast particles, moved by the Kalman update, are a sample of the proposal. The density of the
forecast (the prior) and that of the proposal are estimated from the particles themselves.
"""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import njit_internal
from ..ensemble.kalman_update import Moments, equal_weights, moments_workspace
from ..ensemble.reductions import weighted_cov, weighted_mean
from ..plan import log_density
from .density import density_workspace, kernel_workspace, log_kernel_density, scott_bandwidth


class Scratch(NamedTuple):
    """Moments of the forecast, and scratch of the densities of Eq. 4.36."""

    moments: Moments
    w_equal: np.ndarray
    log_prior: np.ndarray
    log_proposal: np.ndarray
    density: tuple


@njit_internal
def importance_workspace(system, local):
    """Scratch of one update."""
    N, density = local.size, density_workspace(local, system.free.size)
    moments = moments_workspace(system.n, system.p)
    return Scratch(moments, np.empty(N), np.empty(N), np.empty(N), density)


@njit_internal
def reweight(system, k, t, d, members, forecast, n_effective, local, scratch, keeps_previous):
    """Write the unnormalised log-weights of X to log_w and log p(d | x^a) to log_p.

    ``keeps_previous`` keeps the factor w_{d(j)-1,i} of Eq. 4.36. Returns False, with log_w
    unchanged, if proposal and forecast do not spread in the same directions.
    """
    X, w, log_w, log_p = members.X, members.w, members.log_w, members.log_p
    free, n, n_alive, w_equal = system.free, system.n, forecast.n_alive, scratch.w_equal
    kernel_f, kernel_a = kernel_workspace(n, free.size), kernel_workspace(n, free.size)
    equal_weights(members.alive, n_alive, w_equal)
    if not _set_bandwidths(
        members, forecast, n_effective, free, local, scratch, kernel_f, kernel_a
    ):
        return False
    log_density(system, k, t, d, X, log_p)
    log_prior, log_proposal, density = scratch.log_prior, scratch.log_proposal, scratch.density
    log_kernel_density(local, w, members.X_f, X, free, kernel_f, density, log_prior)
    log_kernel_density(local, w_equal, X, X, free, kernel_a, density, log_proposal)
    for i in range(w.size):
        previous = log_w[i] if keeps_previous else -math.log(n_alive)
        log_weight = previous + log_p[i] + (log_prior[i] - log_proposal[i])
        log_w[i] = log_weight if members.alive[i] else -np.inf
    return True


@njit_internal
def _set_bandwidths(members, forecast, n_effective, free, local, scratch, kernel_f, kernel_a):
    X, X_f, w_equal = members.X, members.X_f, scratch.w_equal
    n_alive = forecast.n_alive
    weighted_mean(w_equal, X, 1.0, local, kernel_a.mean)
    for a in range(kernel_f.mean.size):
        kernel_f.mean[a] = scratch.moments.x_mean[a]
    spread_a = 1.0 - 1.0 / n_alive
    weighted_cov(w_equal, X, kernel_a.mean, X, kernel_a.mean, spread_a, local, kernel_a.cov)
    weighted_cov(
        members.w, X_f, kernel_f.mean, X_f, kernel_f.mean, forecast.spread, local, kernel_f.cov
    )
    return (
        scott_bandwidth(n_alive, free, kernel_a)  # Eq. 4.38
        and scott_bandwidth(n_effective, free, kernel_f)
        and _agree(kernel_a.active, kernel_f.active)
    )


@njit_internal
def _agree(spreads_a, spreads_f):
    """Whether two ensembles spread in the same directions."""
    for a in range(spreads_a.size):
        if spreads_a[a] != spreads_f[a]:
            return False
    return True
