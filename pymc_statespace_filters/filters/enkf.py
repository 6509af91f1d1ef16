"""Ensemble Kalman filter with perturbed observations (thesis, section 4.3, Eqs. 4.15-4.26)."""

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from ..compiler.native.entry_point import EntryPoint
from ..compiler.native.jit import inline_always, njit_internal
from ..compiler.native.plan import Plan
from ..compiler.numerics.small_cholesky import log_gaussian
from ..errors import ModelError
from .ensemble.ancestral_smoother import CARRY_PAST, NO_LAG, SMOOTH
from .ensemble.base import EnsembleFilterBase, check_choice, check_count
from .ensemble.evaluation import Members, time_of
from .ensemble.failures import failure_of_all
from .ensemble.kalman_update import (
    Moments,
    check_simulated_observations,
    forecast_covariances,
    forecast_means,
    kalman_update,
    mark_finite,
    moments_workspace,
)
from .ensemble.loop import Outcome, failed, member_filter
from .ensemble.loop import start as start_members
from .ensemble.noise import NoiseSizes, observation_normals
from .outcomes import NONE, SINGULAR
from .plan import log_density, simulate
from .protocol import System

_LIKELIHOODS = ("ensemble", "gaussian")
_ENSEMBLE = 0


class Parts(NamedTuple):
    """The members, the choice of the likelihood, and scratch of one update."""

    members: Members
    is_ensemble: bool
    moments: Moments
    log_terms: np.ndarray
    terms: np.ndarray
    residual: np.ndarray


@njit_internal
def start(call):
    """Draw the members or take those of a state; the step, and the parts."""
    k, (members,) = start_members(call)
    n, p, N = call.system.n, call.system.p, call.local.size
    return k, Parts(
        members=members, is_ensemble=call.settings[0] == _ENSEMBLE,
        moments=moments_workspace(n, p), log_terms=np.empty(N), terms=np.empty(N),
        residual=np.empty(p),
    )  # fmt: skip


@inline_always
def observe(call, j, k, parts):
    """Move the members by the Kalman gain of their own covariances."""
    system, local, t, d = call.system, call.local, time_of(call, k), call.record.observed[j]
    members, moments = parts.members, parts.moments
    X, D, w, alive = members.X, members.D, members.w, members.alive

    # Simulated observations (Eq. 4.15)
    z = observation_normals(call.noise, j, k)
    simulate(system, k, t, z, local.width, X, D)
    mark_finite(X, D, alive)
    for i in range(w.size):
        w[i] = 1.0 if alive[i] else 0.0

    # Moments of the forecast (Eqs. 4.16-4.19), and the mean of p(d | x^f_i)
    if parts.is_ensemble:
        log_density(system, k, t, d, X, members.log_p)
        _fill_log_terms(members, local, parts)
    log_terms, terms = parts.log_terms, parts.terms
    forecast = forecast_means(members, log_terms, terms, parts.is_ensemble, local, moments, False)
    n_alive = forecast.n_alive
    if n_alive == 0.0:
        mark_finite(X, X, alive)
        return failed(failure_of_all(system, k, t, d, members, local))
    if not forecast_covariances(members, d, n_alive - 1.0, local, moments):
        return failed(SINGULAR, n_alive)

    # Increment of the log-likelihood, and how many members carry it (Eq. 4.43)
    increment, n_effective = forecast.log_sum, forecast.n_effective  # Eq. 4.26
    if not parts.is_ensemble:
        increment, n_effective = _gaussian_likelihood(d, parts), n_alive
    if not np.isfinite(increment):
        mark_finite(X, X, alive)
        return failed(failure_of_all(system, k, t, d, members, local))

    # Analysis (Eqs. 4.20-4.21)
    kalman_update(d, D, alive, system.free, moments, X)
    return Outcome(increment, n_effective, n_alive, NONE)


@njit_internal
def _fill_log_terms(members, local, parts):
    """Write log p(d | x^f_i) / N of every member; zero for those that are not alive."""
    log_N = math.log(local.n_members)
    for i in range(members.alive.size):
        parts.log_terms[i] = members.log_p[i] - log_N if members.alive[i] else -np.inf


@njit_internal
def _gaussian_likelihood(d, parts):
    """log N(d; d_bar, P_dd), observed components only."""
    moments, residual, n_present = parts.moments, parts.residual, 0
    for b in range(d.size):
        present = not np.isnan(d[b])
        residual[b] = d[b] - moments.d_mean[b] if present else 0.0
        n_present += present
    return log_gaussian(residual, moments.P_dd, n_present)


@dataclass(frozen=True)
class EnKF(EnsembleFilterBase):
    """Ensemble Kalman filter: nonlinear forecast of every member, linear update by observations.

    Parameters
    ----------
    n_members : int
        Size N of the ensemble, at least 2.
    likelihood : {"ensemble", "gaussian"}
        How p(d_j | d_1 .. d_{j-1}) is estimated from the forecast ensemble. "ensemble" is the mean
        of p(d_j | x_i) over the members (Eq. 4.26); "gaussian" is the normal density with the
        mean and covariance of the simulated observations.

    Raises
    ------
    ModelError
        If ``n_members`` is not an integer of at least 2 or ``likelihood`` is not one of the two
        names.

    Notes
    -----
    The posterior that this filter implies is biased where the state is far from Gaussian, however
    large N.

    With ``process_dist`` members move by normal variables of the means and variances that its
    distributions have given the state: an update leaves fractions and negative numbers, of which
    there is no binomial draw. Variances below zero count as zero.

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

    simulates: ClassVar[bool] = True
    entry: ClassVar[EntryPoint] = member_filter("enkf", observe, start=start)

    def __post_init__(self) -> None:
        object.__setattr__(self, "n_members", check_count("n_members", self.n_members))
        check_choice("likelihood", self.likelihood, _LIKELIHOODS)

    def size(self) -> int:
        """Return the number of members."""
        return self.n_members

    def settings(self, system: System) -> tuple[float, ...]:
        """Return the number of the likelihood."""
        return (_LIKELIHOODS.index(self.likelihood),)

    def check(self, system: System) -> None:
        """Raise if observations cannot be simulated, or a memory would be moved like a number."""
        super().check(system)
        check_simulated_observations(type(self).__name__, system)
        if system.carried and not system.model.has_gaussian_steps:
            raise ModelError(
                f"EnKF moves members by normal variables in place of process_dist, and so cannot "
                f"treat the carried states {list(system.carried)}, such as the number of a regime"
            )

    def noise_sizes(self, system: System) -> NoiseSizes:
        """Return how many normals the filter takes where."""
        return super().noise_sizes(system.with_gaussian_steps)

    def plan(
        self, system: System, run: EntryPoint, functions: Sequence[str], **others: int | EntryPoint
    ) -> Plan:
        """Plan a function of this filter, with normal variables in place of ``process_dist``."""
        return super().plan(system.with_gaussian_steps, run, functions, **others)

    def smoother(self, system: System) -> Plan:
        """Plan the ensemble Kalman smoother for one system."""
        return self.observed(system, SMOOTH, observer=CARRY_PAST, updates=1, lag=NO_LAG)

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""
        return "ensemble Kalman smoother"
