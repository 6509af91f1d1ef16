"""Ensemble and particle filters in plain NumPy, with faults that can be switched on.

Each fault is one line that somebody has written in earnest. A check that these filters pass when
whole and fail with a fault is a check worth giving to the package's own filters. Equation numbers
are the thesis's.
"""

from collections.abc import Callable
from enum import Flag, auto
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tests.references.records import DoubleWell, LinearSystem, Record

Array = NDArray[np.float64]


class Fault(Flag):
    """What can be wrong."""

    NONE = 0
    UNPERTURBED_OBSERVATIONS = auto()  # Eq. 4.21 with h(x, 0) in place of Eq. 4.15
    NO_FORECAST_DETERMINANT = auto()  # Eq. 4.36 without 1 / |H_f|
    NO_ANALYSIS_DETERMINANT = auto()  # Eq. 4.36 without 1 / |H_a|
    EXTRA_PREVIOUS_WEIGHT = auto()  # Eq. 4.36 with the factor w_{d(j)-1} that it prints
    POST_UPDATE_WEIGHTS = auto()  # Eq. 4.42 as printed, with weights that have seen d_j already
    WEIGHTS_FORGOTTEN = auto()  # weights reset although the particles were not resampled


# (particles (N, n), weights (N,), d, C, R, generator) -> (likelihood of d, particles, weights)
Update = Callable[..., tuple[float, Array, Array]]


def run(
    system: LinearSystem | DoubleWell,
    record: Record,
    update: Update,
    n_particles: int,
    rng: np.random.Generator,
    *,
    resample_below: float = 0.0,
    fault: Fault = Fault.NONE,
) -> Array:
    """Log-likelihood terms (J,) of one run of a filter."""
    uniform = np.full(n_particles, 1.0 / n_particles)
    x = system.start(n_particles, rng)
    weights, now, terms = uniform, 0, np.zeros(len(record.steps))
    observed = record.observed.reshape(len(record.steps), -1)
    for j, step in enumerate(record.steps):
        for _ in range(step - now):
            x = system.move(x, rng)
        now, d = step, observed[j]
        seen = ~np.isnan(d)
        if not seen.any():
            continue
        C, R = system.C[seen], system.R[np.ix_(seen, seen)]
        likelihood, x, weights = update(x, weights, d[seen], C, R, rng, fault)
        terms[j] = np.log(likelihood)
        if 1.0 < resample_below * n_particles * (weights @ weights):
            x, weights = x[_systematic(weights, rng)], uniform
        elif Fault.WEIGHTS_FORGOTTEN in fault:
            weights = uniform
    return terms


def enkf(x, weights, d, C, R, rng, fault):
    """Eqs. 4.15-4.21 and 4.26; the weights are and stay uniform."""
    likelihood = weights @ _normal_density(d - x @ C.T, R)
    return likelihood, _nudged(x, weights, d, C, R, rng, fault), weights


def bootstrap(x, weights, d, C, R, rng, fault):
    """Eq. 4.28."""
    density = _normal_density(d - x @ C.T, R)
    weights_after = _normalised(weights * density)
    weights_seen = weights_after if Fault.POST_UPDATE_WEIGHTS in fault else weights
    return weights_seen @ density, x, weights_after


def pf_enkf(x, weights, d, C, R, rng, fault, *, likelihood="predictive"):
    """Eqs. 4.29-4.39 without the factor of w_{d(j)-1}; "predictive" or "weights" likelihood."""
    N, n = x.shape
    proposed = _nudged(x, weights, d, C, R, rng, fault)
    n_effective = 1.0 / (weights @ weights)
    H_f = n_effective ** (-1 / (n + 4)) * np.linalg.cholesky(_covariance(x, x, weights))
    uniform = np.full(N, 1.0 / N)
    H_a = N ** (-1 / (n + 4)) * np.linalg.cholesky(_covariance(proposed, proposed, uniform))
    ratio = _kernel_sum(proposed, x, weights, H_f) / _kernel_sum(proposed, proposed, uniform, H_a)
    if Fault.NO_FORECAST_DETERMINANT in fault:
        ratio = ratio * np.linalg.det(H_f)
    if Fault.NO_ANALYSIS_DETERMINANT in fault:
        ratio = ratio / np.linalg.det(H_a)
    density = _normal_density(d - proposed @ C.T, R)
    unnormalised = density * ratio / N
    if Fault.EXTRA_PREVIOUS_WEIGHT in fault:
        unnormalised = density * ratio * weights
    weights_after = _normalised(unnormalised)
    if Fault.POST_UPDATE_WEIGHTS in fault:
        return weights_after @ density, proposed, weights_after
    if likelihood == "weights":
        return unnormalised.sum(), proposed, weights_after
    return weights @ _normal_density(d - x @ C.T, R), proposed, weights_after


pf_enkf_weights = partial(pf_enkf, likelihood="weights")


def _nudged(x, weights, d, C, R, rng, fault):
    """Eqs. 4.29-4.35, of which 4.15-4.21 are the case of uniform weights."""
    noise = rng.multivariate_normal(np.zeros(len(R)), R, size=len(x))
    seen = x @ C.T + noise
    K = np.linalg.solve(_covariance(seen, seen, weights), _covariance(seen, x, weights)).T
    if Fault.UNPERTURBED_OBSERVATIONS in fault:
        seen = x @ C.T
    return x + (d - seen) @ K.T


def _covariance(x, y, weights):
    x_off, y_off = x - weights @ x, y - weights @ y
    return (weights[:, None] * x_off).T @ y_off / (1.0 - weights @ weights)


def _normal_density(residual, cov):
    whitened = np.linalg.solve(np.linalg.cholesky(cov), residual.T)
    return np.exp(-0.5 * (whitened**2).sum(axis=0)) / np.sqrt(np.linalg.det(2.0 * np.pi * cov))


def _kernel_sum(points, centres, weights, H):
    """sum_l w_l K(H^-1 (c_l - x_i)) / |H| at every point i, but for (2 pi)^(-n/2)."""
    a, b = np.linalg.solve(H, points.T).T, np.linalg.solve(H, centres.T).T
    exponent = a @ b.T - 0.5 * (b**2).sum(axis=1) - 0.5 * (a**2).sum(axis=1)[:, None]
    return np.exp(exponent, out=exponent) @ weights / np.linalg.det(H)


def _systematic(weights, rng):
    positions = (rng.random() + np.arange(len(weights))) / len(weights)
    return np.minimum(np.searchsorted(np.cumsum(weights), positions), len(weights) - 1)


def _normalised(weights):
    return weights / weights.sum()
