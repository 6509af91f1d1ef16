"""Particle filter with an ensemble Kalman proposal (thesis, section 4.4, Eqs. 4.29-4.44)."""

from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ..compiler.native.entry_point import EntryPoint
from ..compiler.native.jit import inline_always, njit_internal
from ..errors import ModelError
from .bootstrap import BootstrapPF
from .ensemble.base import check_choice
from .ensemble.evaluation import Members, time_of
from .ensemble.failures import failure_of_all
from .ensemble.kalman_update import (
    copy_members,
    forecast_covariances,
    forecast_means,
    kalman_update,
    mark_finite,
)
from .ensemble.loop import Outcome, failed, member_filter
from .ensemble.loop import start as start_members
from .ensemble.noise import observation_normals
from .ensemble.particle_filter import ParticleFilter
from .ensemble.weights import normalise_weights
from .kernel_density.density import Scratch, density_method, importance_workspace, reweight
from .outcomes import NONE
from .plan import log_density, simulate
from .protocol import System

_ONE_PARTICLE = 1e-10  # 1 - sum w^2 below this: one particle has all the weight, no covariance

_LIKELIHOODS = ("predictive", "weights")
_PREDICTIVE = 0


class Parts(NamedTuple):
    """The particles, the choice of the likelihood, and scratch of an update."""

    members: Members
    likelihood: int
    scratch: Scratch


@njit_internal
def start(call):
    """Draw the particles or take those of a state; the step, and the parts."""
    k, (members,) = start_members(call)
    return k, Parts(members, int(call.settings[0]), importance_workspace(call.system, call.local))


@inline_always
def observe(call, j, k, parts):
    """Move the particles by a Kalman gain, and weight them for the densities that this changes."""
    system, local, t, d = call.system, call.local, time_of(call, k), call.record.observed[j]
    members, likelihood, scratch = parts
    X, log_w, alive = members.X, members.log_w, members.alive

    # Simulated observations (Eq. 4.29), and previous weights of the particles that are alive
    simulate(system, k, t, observation_normals(call.noise, j, k), local.width, X, members.D)
    mark_finite(X, members.D, alive)
    for i in range(log_w.size):
        log_w[i] = log_w[i] if alive[i] else -np.inf
    log_alive, n_previous = normalise_weights(log_w, members.w, local)
    if log_alive == -np.inf:
        mark_finite(X, X, alive)
        return failed(failure_of_all(system, k, t, d, members, local))

    # Predicted density of the observation: previous weights on the forecast particles
    log_density(system, k, t, d, X, members.log_p)
    log_terms = _log_weighted_density(members, scratch)
    forecast = forecast_means(
        members, log_terms, scratch.w_equal, True, local, scratch.moments, True
    )

    # Proposal (Eqs. 4.30-4.35) and weights (Eq. 4.36); without a proposal those of Eq. 4.28
    copy_members(X, members.X_f)
    if not (
        _propose(d, members, forecast.spread, system.free, local, scratch.moments)
        and reweight(system, k, t, d, members, forecast, n_previous, local, scratch)
    ):
        copy_members(members.X_f, X)
        log_density(system, k, t, d, X, members.log_p)
        for i in range(log_w.size):
            log_w[i] += members.log_p[i]
    log_total, n_weighted = normalise_weights(log_w, members.w, local)  # Eqs. 4.37, 4.43

    # Increment of the log-likelihood, the log of a mean, and the effective number of its weights
    if likelihood == _PREDICTIVE:  # Eq. 4.42 without its double count
        increment, n_effective = log_alive + forecast.log_sum, forecast.n_effective
    else:  # of the mean unnormalised weight: importance sampling
        increment, n_effective = log_alive + log_total, n_weighted
    if not (np.isfinite(increment) and np.isfinite(log_total)):
        mark_finite(X, X, alive)
        return failed(failure_of_all(system, k, t, d, members, local))
    return Outcome(increment, n_effective, n_weighted, NONE)


@njit_internal
def _log_weighted_density(members, scratch):
    """log w_i p(d | x_i) of every particle."""
    for i in range(members.log_w.size):
        scratch.log_prior[i] = members.log_w[i] + members.log_p[i]
    return scratch.log_prior


@njit_internal
def _propose(d, members, spread, free, local, moments):
    """Move X by the Kalman gain; False if the covariance is singular or not finite."""
    if not (spread > _ONE_PARTICLE and forecast_covariances(members, d, spread, local, moments)):
        return False
    kalman_update(d, members.D, members.alive, free, moments, members.X)
    return True


@dataclass(frozen=True)
class PFEnKF(ParticleFilter):
    """Particle filter whose proposal is an ensemble Kalman update.

    Parameters
    ----------
    n_particles : int
        Number N of particles, at least 2.
    resample_below : float
        Resample after an observation if the effective number of particles (Eq. 4.43) is below this
        fraction of N: 1 resamples at every observation, 0 never.
    resampling : {"systematic", "multinomial", "sorted"}
        Resampling scheme; "multinomial" is the thesis's, "systematic" has less noise. "sorted" is
        systematic resampling of sorted particles: by size with one state, along a Hilbert curve
        with two to eight. The estimate then changes little when its normals do.
    likelihood : {"predictive", "weights"}
        How p(d_j | d_1 .. d_{j-1}) is estimated. "predictive": previous weights on the forecast
        particles. "weights": log of the mean unnormalised weight.

    Raises
    ------
    ModelError
        If ``n_particles`` is not an integer of at least 2, ``resample_below`` is not between 0 and
        1, or a name is not in its list.

    Notes
    -----
    Differences from the source. The factor w_{d(j)-1,i} of Eq. 4.36 is dropped: the sum over the
    previous weights in its numerator already carries it. "predictive" is Eq. 4.42 with the weights
    from before the update, on the forecast particles: as printed it counts the observation twice.
    N_eff in Eq. 4.39 is that of the weights before the update. A direction in which the forecast
    has no spread is left out of the densities. Where no proposal can be built (one particle has all
    the weight, or a covariance is singular or not finite) the update is that of the bootstrap
    filter.

    With `observation_dist`, `observation_logp` or censored data observations are not simulated, no
    particle is moved, and the filter is the bootstrap filter.

    A particle with a non-finite state or simulated observation has weight zero. Carried states move
    with their particle, are not updated and are not part of the kernel densities.

    Examples
    --------
    >>> PFEnKF(1000).likelihood
    'predictive'
    """

    _: KW_ONLY
    likelihood: str = "predictive"

    simulates: ClassVar[bool] = True
    entry: ClassVar[EntryPoint] = member_filter("pf_enkf", observe, start=start)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("likelihood", self.likelihood, _LIKELIHOODS)

    def density_method(self, system: Any) -> str:
        """How the kernel densities are summed for a system whose free states all spread.

        Parameters
        ----------
        system : StateSpaceModel

        Returns
        -------
        str
            "lattice" (sums over a grid, O(N)), "exact" (exact sums, O(N^2)), or "none" where no
            particle is moved and the filter is the bootstrap filter.

        Examples
        --------
        >>> import pymc_statespace_filters as psf
        >>> walk = psf.StateSpaceModel(
        ...     transition=lambda x, q: [x[0] + q[0]],
        ...     process_noise=[[1.0]],
        ...     observation=lambda x: [x[0]],
        ...     observation_noise=[[0.5]],
        ...     initial_mean=[0.0],
        ...     initial_cov=[[1.0]],
        ... )
        >>> psf.PFEnKF(1000).density_method(walk), psf.PFEnKF(30).density_method(walk)
        ('lattice', 'exact')
        """
        n_free = system.n - len(system.carried)
        if not system.gaussian_observation or n_free == 0:
            return "none"
        return density_method(n_free, self.n_particles)

    def check(self, system: System) -> None:
        """Raise if particles would be moved off whole numbers, or as `ParticleFilter`."""
        super().check(system)
        if system.model.discrete_noise and self.algorithm(system) is self:
            raise ModelError(
                "PFEnKF moves particles by a Kalman gain, off the whole numbers that process_dist "
                "draws, got discrete distributions"
            )

    def settings(self, system: System) -> tuple[float, ...]:
        """Return the number of the likelihood."""
        return (_LIKELIHOODS.index(self.likelihood),)

    def algorithm(self, system: System) -> ParticleFilter:
        """Return the bootstrap filter where no Kalman gain exists or it would move nothing."""
        if system.gaussian_observation and system.free.size > 0:
            return self
        return BootstrapPF(
            self.n_particles, resample_below=self.resample_below, resampling=self.resampling
        )
