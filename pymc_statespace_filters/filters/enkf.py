"""Ensemble Kalman filter with perturbed observations (thesis, section 4.3, Eqs. 4.15-4.26)."""

import math
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from pymc_statespace_filters.compiler.lowering.ensemble import Machine
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint
from pymc_statespace_filters.compiler.native.jit import inline_always
from pymc_statespace_filters.compiler.numerics.small_cholesky import log_gaussian
from pymc_statespace_filters.filters.ensemble.ancestral_smoother import past_kernel
from pymc_statespace_filters.filters.ensemble.base import EnsembleFilter
from pymc_statespace_filters.filters.ensemble.kalman_update import (
    forecast_moments,
    kalman_update,
    mark_finite,
)
from pymc_statespace_filters.filters.ensemble.loop import filter_entry
from pymc_statespace_filters.filters.ensemble.noise import observation_normals
from pymc_statespace_filters.filters.ensemble.reductions import (
    exchange,
    means,
    sum_members,
    sum_values,
    total,
)
from pymc_statespace_filters.filters.ensemble.system_table import log_density, observe
from pymc_statespace_filters.filters.ensemble.weights import total_weight, weigh
from pymc_statespace_filters.filters.outcomes import (
    COVARIANCE_NOT_POSITIVE,
    NO_FINITE_MEMBER,
    NONE,
    ZERO_WEIGHTS,
)
from pymc_statespace_filters.filters.settings import check_choice, check_count
from pymc_statespace_filters.system.model import StateSpaceModel

_LIKELIHOODS = ("ensemble", "gaussian")
_ENSEMBLE = 0


class _Scratch(NamedTuple):
    """Of one update: moments of the forecast, and what the two likelihoods need."""

    moments: tuple
    log_share: np.ndarray
    share: np.ndarray
    residual: np.ndarray


@inline_always
def _workspace(system, local, settings):
    n, p = system.n, system.p
    moments = (np.empty(n), np.empty(p), np.empty((n, p)), np.empty((p, p)))
    scratch = _Scratch(moments, np.empty(local.size), np.empty(local.size), np.empty(p))
    return settings[0] == _ENSEMBLE, scratch


@inline_always
def _update(system, j, k, t, d, noise, members, local, work):
    X, D, _, w, _, log_p, alive = members
    of_ensemble, (moments, log_share, share, residual) = work
    n, p = system.n, system.p

    # Simulated observations
    observe(system, k, t, observation_normals(noise, j, k), noise.sizes.width, X, D)  # Eq. 4.15
    mark_finite(X, D, alive)

    # Sums over the members of all ranks, in one exchange
    for i in range(alive.size):
        w[i] = 1.0 if alive[i] else 0.0
    sum_values(w, local, 0)
    sum_members(w, X, local, 1)
    sum_members(w, D, local, 1 + n)
    n_rows = 1 + n + p
    if of_ensemble:
        log_density(system, k, t, d, X, log_p)
        log_N = math.log(local.n_members)
        for i in range(alive.size):
            log_share[i] = log_p[i] - log_N if alive[i] else -np.inf
        weigh(log_share, share, local, n_rows)
    exchange(local, n_rows + 3 * of_ensemble)
    n_alive = total(local, 0)
    if n_alive == 0.0:
        return -np.inf, 0.0, NO_FINITE_MEMBER

    # Moments of the forecast
    x_mean, d_mean, _, _ = moments
    means(local, 1, n_alive, x_mean)  # Eq. 4.16
    means(local, 1 + n, n_alive, d_mean)
    # The mean over the members of p(d | x^f_i), Eq. 4.26. How many members carry it is the same
    # question as in a particle filter (Eq. 4.43).
    increment, n_effective = total_weight(local, n_rows) if of_ensemble else (0.0, n_alive)
    if not forecast_moments(w, X, D, d, n_alive - 1.0, local, moments):  # Eqs. 4.17-4.19
        return -np.inf, n_alive, COVARIANCE_NOT_POSITIVE

    # Increment of the log-likelihood
    if not of_ensemble:
        increment = _gaussian_fit(d, moments, residual)
    if not np.isfinite(increment):
        return -np.inf, 0.0, ZERO_WEIGHTS

    # Analysis
    kalman_update(d, D, alive, system.free, moments, X)  # Eqs. 4.20-4.21
    return increment, n_effective, NONE


@inline_always
def _gaussian_fit(d, moments, residual):
    """log N(d; d_bar, P_dd), observed components only."""
    _, d_mean, _, P_dd_chol = moments
    n_present = 0
    for b in range(d.size):
        present = not np.isnan(d[b])
        residual[b] = d[b] - d_mean[b] if present else 0.0
        n_present += present
    return log_gaussian(residual, P_dd_chol, n_present)


@dataclass(frozen=True)
class EnKF(EnsembleFilter):
    """Ensemble Kalman filter: nonlinear forecast of every member, linear update by observations.

    Parameters
    ----------
    n_members : int
        Size N of the ensemble, at least 2.
    likelihood : {"ensemble", "gaussian"}
        How p(d_j | d_1 .. d_{j-1}) is read off the forecast ensemble. "ensemble" is the mean of
        p(d_j | x_i) over the members (Eq. 4.26); "gaussian" is the normal density with mean and
        covariance of the simulated observations.

    Raises
    ------
    ModelError
        If ``n_members`` is not an integer of at least 2 or ``likelihood`` is not one of the two
        names.

    Notes
    -----
    The posterior that this filter implies is biased where the state is far from Gaussian, however
    large N.

    A member with a non-finite state or simulated observation is left out of the moments and is not
    updated. In Eq. 4.26 it counts as zero, and the mean still divides by N.

    Examples
    --------
    >>> EnKF(1250)
    EnKF(n_members=1250, likelihood='ensemble')
    """

    n_members: int
    _: KW_ONLY
    likelihood: str = "ensemble"

    needs_simulated_observations: ClassVar[bool] = True
    simulates: ClassVar[bool] = True
    entry: ClassVar[EntryPoint] = filter_entry(
        "enkf", _workspace, _update, n_settings=1, resamples=False
    )

    def __post_init__(self) -> None:
        object.__setattr__(self, "n_members", check_count("n_members", self.n_members))
        check_choice("likelihood", self.likelihood, _LIKELIHOODS)

    def size(self) -> int:
        """Return the number of members."""
        return self.n_members

    def settings(self) -> tuple[float, ...]:
        """Return the number of the likelihood."""
        return (_LIKELIHOODS.index(self.likelihood),)

    def smoother(self, system: StateSpaceModel, machine: Machine) -> Any:
        """Bind the ensemble Kalman smoother to one system."""
        with_callback, never = self.with_callback(machine), np.iinfo(np.int64).max // 2
        return past_kernel(with_callback, machine, self.n_members, nudges=True, lag=never)

    def smoothing_method(self, system: StateSpaceModel) -> str:
        """Name the method of the smoothed states."""
        return "ensemble Kalman smoother"
