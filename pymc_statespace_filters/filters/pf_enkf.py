"""Particle filter with an ensemble Kalman proposal (thesis, section 4.4, Eqs. 4.29-4.44)."""

from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np

from pymc_statespace_filters.compiler.lowering.ensemble import Machine
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint
from pymc_statespace_filters.compiler.native.jit import inline_always
from pymc_statespace_filters.filters.bootstrap import BootstrapPF
from pymc_statespace_filters.filters.ensemble.base import EnsembleFilter
from pymc_statespace_filters.filters.ensemble.kalman_update import (
    copy_members,
    forecast_moments,
    kalman_update,
    mark_finite,
)
from pymc_statespace_filters.filters.ensemble.loop import filter_entry
from pymc_statespace_filters.filters.ensemble.noise import observation_normals
from pymc_statespace_filters.filters.ensemble.particle_filter import (
    particle_smoother,
    particle_smoothing_method,
)
from pymc_statespace_filters.filters.ensemble.reductions import (
    exchange,
    means,
    sum_members,
    sum_spread,
    sum_values,
    total,
)
from pymc_statespace_filters.filters.ensemble.resampling import (
    SCHEMES,
    check_sortable,
    n_normals,
    smooth_resampling,
)
from pymc_statespace_filters.filters.ensemble.system_table import log_density, observe
from pymc_statespace_filters.filters.ensemble.weights import normalise_local, total_weight, weigh
from pymc_statespace_filters.filters.kernel_density.density import density_method
from pymc_statespace_filters.filters.kernel_density.importance_weights import (
    Forecast,
    importance_workspace,
    reweight,
)
from pymc_statespace_filters.filters.outcomes import NO_FINITE_MEMBER, NONE, ZERO_WEIGHTS
from pymc_statespace_filters.filters.settings import check_choice, check_count, check_fraction
from pymc_statespace_filters.system.model import StateSpaceModel

_ONE_PARTICLE = 1e-10  # 1 - sum w^2 below this: one particle has all the weight, no covariance

_LIKELIHOODS = ("predictive", "weights", "as_printed")
_PREDICTIVE, _WEIGHTS, _AS_PRINTED = range(3)


@inline_always
def _workspace(system, local, settings):
    return np.int64(settings[2]), importance_workspace(system, local)


@inline_always
def _update(system, j, k, t, d, noise, members, local, work):
    X, D, X_f, w, log_w, log_p, alive = members
    likelihood, scratch = work

    # Simulated observations and previous weights, of the particles that are alive
    observe(system, k, t, observation_normals(noise, j, k), noise.sizes.width, X, D)  # Eq. 4.29
    mark_finite(X, D, alive)
    n_alive, n_effective, log_alive = _weigh_alive(members, local)
    if n_alive == 0.0:
        return -np.inf, 0.0, NO_FINITE_MEMBER
    if log_alive == -np.inf:
        return -np.inf, 0.0, ZERO_WEIGHTS

    # Predicted density of the observation, then proposal and weights
    log_density(system, k, t, d, X, log_p)
    copy_members(X, X_f)
    forecast = _forecast(n_alive, n_effective, members, local, scratch)
    as_printed = likelihood == _AS_PRINTED
    if not (
        forecast.spread > _ONE_PARTICLE
        and _nudge(system, d, members, forecast, local, scratch)  # Eqs. 4.30-4.35
        and reweight(system, k, t, d, members, forecast, local, scratch, as_printed)  # Eq. 4.36
    ):
        copy_members(X_f, X)
        log_density(system, k, t, d, X, log_p)
        for i in range(w.size):
            log_w[i] += log_p[i]  # Eq. 4.28
    n_effective, log_total, log_printed = _normalise(members, local, scratch)  # Eqs. 4.37, 4.43
    if likelihood == _PREDICTIVE:
        increment = log_alive + forecast.log_mean  # Eq. 4.42 without its double count
    elif likelihood == _WEIGHTS:
        increment = log_alive + log_total  # of the mean unnormalised weight: importance sampling
    else:
        increment = log_printed  # Eq. 4.42 to the letter
    if not (np.isfinite(increment) and np.isfinite(log_total)):
        return -np.inf, 0.0, ZERO_WEIGHTS
    return increment, n_effective, NONE


@inline_always
def _weigh_alive(members, local):
    """Normalise the weights of who is alive; return how many are, N_eff, and the log of the sum."""
    _, _, _, w, log_w, _, alive = members
    for i in range(w.size):
        log_w[i] = log_w[i] if alive[i] else -np.inf
    weigh(log_w, w, local, 0)
    sum_values(alive, local, 3)
    exchange(local, 4)
    log_alive, n_effective = total_weight(local, 0)
    if log_alive > -np.inf:
        normalise_local(log_alive, log_w, w, local, 0)
    return total(local, 3), n_effective, log_alive


@inline_always
def _forecast(n_alive, n_effective, members, local, scratch):
    """Means of the forecast, and its p(d | x)."""
    X, D, _, w, log_w, log_p, _ = members
    x_mean, d_mean, _, _ = scratch.moments
    n, p = X.shape[0], D.shape[0]
    for i in range(w.size):
        scratch.log_prior[i] = log_w[i] + log_p[i]
    sum_spread(w, local, 0)
    sum_members(w, X, local, 1)
    sum_members(w, D, local, 1 + n)
    weigh(scratch.log_prior, scratch.w_equal, local, 1 + n + p)
    exchange(local, 1 + n + p + 3)
    means(local, 1, 1.0, x_mean)
    means(local, 1 + n, 1.0, d_mean)
    return Forecast(n_alive, n_effective, total(local, 0), total_weight(local, 1 + n + p)[0])


@inline_always
def _nudge(system, d, members, forecast, local, scratch):
    """Move X by the Kalman gain; False if its covariance is singular or not finite."""
    X, D, _, w, _, _, alive = members
    if not forecast_moments(w, X, D, d, forecast.spread, local, scratch.moments):  # Eqs. 4.30-4.33
        return False
    kalman_update(d, D, alive, system.free, scratch.moments, X)  # Eqs. 4.34-4.35
    return True


@inline_always
def _normalise(members, local, scratch):
    """Normalise the weights; return N_eff, the log of their sum, and Eq. 4.42 to the letter."""
    _, _, _, w, log_w, log_p, _ = members
    weigh(log_w, w, local, 0)
    for i in range(w.size):
        scratch.log_prior[i] = log_w[i] + log_p[i]
    weigh(scratch.log_prior, scratch.w_equal, local, 3)
    exchange(local, 6)
    log_total, n_effective = total_weight(local, 0)
    if log_total > -np.inf:
        normalise_local(log_total, log_w, w, local, 0)
    return n_effective, log_total, total_weight(local, 3)[0] - log_total


@dataclass(frozen=True)
class PFEnKF(EnsembleFilter):
    """Particle filter whose particles an ensemble Kalman update nudges before they are weighted.

    Parameters
    ----------
    n_particles : int
        Number N of particles, at least 2.
    resample_below : float
        Resample after an observation if the effective number of particles (Eq. 4.43) is below this
        fraction of N: 1 resamples at every observation, 0 never.
    resampling : {"systematic", "multinomial", "sorted"}
        Scheme; "multinomial" is the thesis's, "systematic" has less noise. "sorted" is systematic
        along particles in order, one state by its size, up to eight along a Hilbert curve: the
        estimate then moves little when its normals do.
    likelihood : {"predictive", "weights", "as_printed"}
        How p(d_j | d_1 .. d_{j-1}) is estimated. "predictive": previous weights on the forecast
        particles. "weights": log of the mean unnormalised weight. "as_printed": Eqs. 4.36 and 4.42
        to the letter, which count the previous weights and the likelihood twice and come out too
        high, by 0.3 (coarse sensor) to 1.2 (precise sensor) nats per observation.

    Raises
    ------
    ModelError
        If ``n_particles`` is not an integer of at least 2, ``resample_below`` is not between 0 and
        1, or a name is not in its list.

    Notes
    -----
    Differences from the source. The factor w_{d(j)-1,i} of Eq. 4.36 is dropped (except
    "as_printed"): the sum over the previous weights in its numerator already carries it. N_eff in
    Eq. 4.39 is that of the weights before the update. A direction in which the forecast has no
    spread is left out of the densities. Where no proposal can be built (one particle has all the
    weight, or a covariance is singular or not finite) the update is that of the bootstrap filter.

    With `observation_dist` or `observation_logp` observations are not simulated, no particle is
    nudged, and the filter is the bootstrap filter.

    A particle with a non-finite state or simulated observation has weight zero. Carried states move
    with their particle, are not nudged and are not part of the kernel densities.

    Examples
    --------
    >>> PFEnKF(1000).likelihood
    'predictive'
    """

    n_particles: int
    _: KW_ONLY
    resample_below: float = 1 / 3
    resampling: str = "systematic"
    likelihood: str = "predictive"

    simulates: ClassVar[bool] = True
    entry: ClassVar[EntryPoint] = filter_entry(
        "pf_enkf", _workspace, _update, n_settings=3, resamples=True
    )

    def __post_init__(self) -> None:
        object.__setattr__(self, "n_particles", check_count("n_particles", self.n_particles))
        fraction = check_fraction("resample_below", self.resample_below)
        object.__setattr__(self, "resample_below", fraction)
        check_choice("resampling", self.resampling, SCHEMES)
        check_choice("likelihood", self.likelihood, _LIKELIHOODS)

    def density_method(self, system: StateSpaceModel) -> str:
        """How the kernel densities are summed for a system whose free states all spread.

        Parameters
        ----------
        system : StateSpaceModel

        Returns
        -------
        str
            "lattice" (O(N)), "exact" (O(N^2)), or "none" where nothing is nudged and the filter is
            the bootstrap filter.

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

    def size(self) -> int:
        """Return the number of particles."""
        return self.n_particles

    def settings(self) -> tuple[float, ...]:
        """Return the threshold of resampling and the numbers of its scheme and the likelihood."""
        likelihood = _LIKELIHOODS.index(self.likelihood)
        return self.resample_below, SCHEMES.index(self.resampling), likelihood

    def check(self, system: StateSpaceModel) -> None:
        """Raise if particles of so many states cannot be ordered and are to be."""
        super().check(system)
        check_sortable(self.resampling, system.n)

    def smooth(self, system: StateSpaceModel) -> EnsembleFilter:
        """Return this filter with an estimate that changes little when its normals do."""
        return smooth_resampling(self, system.n)

    def resampling_normals(self) -> int:
        """Return how many normals a resampling takes."""
        return n_normals(self.resampling, self.n_particles)

    def algorithm(self, machine: Machine) -> EnsembleFilter:
        """Return the bootstrap filter if there is nothing to nudge by, or nothing to nudge."""
        if machine.observe is not None and machine.free.size > 0:
            return self
        return BootstrapPF(
            self.n_particles, resample_below=self.resample_below, resampling=self.resampling
        )

    def smoother(self, system: StateSpaceModel, machine: Machine) -> Any:
        """Bind the smoother of this filter to one system."""
        return particle_smoother(self, system, machine, nudges=True)

    def smoothing_method(self, system: StateSpaceModel) -> str:
        """Name the method of the smoothed states."""
        return particle_smoothing_method(system)
