"""Ensemble Kalman filter with perturbed observations (thesis, section 4.3, Eqs. 4.15-4.26)."""

import math
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np

from pymc_statespace_filters.filters._base import EnsembleFilter
from pymc_statespace_filters.filters._checks import check_choice, check_count
from pymc_statespace_filters.filters._compile import pasted
from pymc_statespace_filters.filters._ensemble import (
    equal_weights,
    forecast_moments,
    mark_finite,
    nudge,
)
from pymc_statespace_filters.filters._failures import (
    COVARIANCE_NOT_POSITIVE,
    NO_FINITE_MEMBER,
    NONE,
    ZERO_WEIGHTS,
)
from pymc_statespace_filters.filters._gaussian import log_gaussian
from pymc_statespace_filters.filters._loop import filter_entry
from pymc_statespace_filters.filters._noise import observation_normals
from pymc_statespace_filters.filters._past import past_kernel
from pymc_statespace_filters.filters._system import log_density, observe
from pymc_statespace_filters.filters._weights import effective_number, normalise
from pymc_statespace_filters.lowering import Machine
from pymc_statespace_filters.machine_code import Entry
from pymc_statespace_filters.model import StateSpaceModel

_LIKELIHOODS = ("ensemble", "gaussian")
_ENSEMBLE = 0


@pasted
def _ensemble_mean(log_w, log_p, w):
    """Mean over the members of p(d | x^f_i): the log of Eq. 4.26.

    How many members carry the mean is the same question as in a particle filter (Eq. 4.43).
    """
    for i in range(log_w.size):
        log_w[i] += log_p[i]
    increment = normalise(log_w, w)
    return increment, effective_number(w) if increment > -np.inf else 0.0


@pasted
def _gaussian_fit(d, moments, residual, n_alive):
    """log N(d; d_bar, P_dd), observed components only; every member alive carries it."""
    _, d_mean, _, P_dd_chol = moments
    n_present = 0
    for b in range(d.size):
        present = not np.isnan(d[b])
        residual[b] = d[b] - d_mean[b] if present else 0.0
        n_present += present
    return log_gaussian(residual, P_dd_chol, n_present), float(n_alive)


@pasted
def _workspace(system, n_members, width, settings):
    n, p = system.n, system.p
    moments = (np.empty(n), np.empty(p), np.empty((n, p)), np.empty((p, p)))
    return settings[0] == _ENSEMBLE, np.empty(n_members), moments, np.empty(p)


@pasted
def _update(system, j, k, t, d, noise, members, work):
    X, D, _, w, _, log_p, alive = members
    of_ensemble, log_share, moments, residual = work

    # Simulated observations
    observe(system, k, t, observation_normals(noise, j, k), noise.sizes.width, X, D)  # Eq. 4.15
    n_alive = mark_finite(X, D, alive)
    if n_alive == 0:
        return -np.inf, 0.0, NO_FINITE_MEMBER

    # Moments of the forecast
    equal_weights(alive, n_alive, w)
    if not forecast_moments(w, X, D, d, moments):  # Eqs. 4.16-4.19
        return -np.inf, float(n_alive), COVARIANCE_NOT_POSITIVE

    # Increment of the log-likelihood
    if of_ensemble:
        log_density(system, k, t, d, X, log_p)
        log_N = math.log(alive.size)
        for i in range(alive.size):
            log_share[i] = -log_N if alive[i] else -np.inf
        increment, n_effective = _ensemble_mean(log_share, log_p, w)  # Eq. 4.26
    else:
        increment, n_effective = _gaussian_fit(d, moments, residual, n_alive)
    if not np.isfinite(increment):
        return -np.inf, 0.0, ZERO_WEIGHTS

    # Analysis
    nudge(d, D, alive, system.free, moments, X)  # Eqs. 4.20-4.21
    return increment, n_effective, NONE


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
    entry: ClassVar[Entry] = filter_entry(
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
        watched, never = self.watched(machine), np.iinfo(np.int64).max // 2
        return past_kernel(watched, machine, self.n_members, nudges=True, lag=never)

    def smoothing_method(self, system: StateSpaceModel) -> str:
        """Name the method of the smoothed states."""
        return "ensemble Kalman smoother"
