"""Particle filter with an ensemble Kalman proposal (thesis, section 4.4, Eqs. 4.29-4.44)."""

import math
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from pymc_statespace_filters.filters._base import EnsembleFilter
from pymc_statespace_filters.filters._checks import check_choice, check_count, check_fraction
from pymc_statespace_filters.filters._compile import compiled, pasted
from pymc_statespace_filters.filters._ensemble import (
    copy_members,
    count_true,
    equal_weights,
    forecast_moments,
    mark_finite,
    nudge,
    spread_factor,
)
from pymc_statespace_filters.filters._failures import NO_FINITE_MEMBER, NONE, ZERO_WEIGHTS
from pymc_statespace_filters.filters._kernel_density import (
    density_method,
    density_workspace,
    log_kernel_density,
    scott_bandwidth,
)
from pymc_statespace_filters.filters._loop import filter_entry
from pymc_statespace_filters.filters._noise import observation_normals
from pymc_statespace_filters.filters._particle_smoother import (
    particle_smoother,
    particle_smoothing_method,
)
from pymc_statespace_filters.filters._resampling import (
    SCHEMES,
    check_sortable,
    n_normals,
    smooth_resampling,
)
from pymc_statespace_filters.filters._system import log_density, observe
from pymc_statespace_filters.filters._weights import effective_number, log_sum, normalise
from pymc_statespace_filters.filters.bootstrap import BootstrapPF
from pymc_statespace_filters.lowering import Machine
from pymc_statespace_filters.machine_code import Entry
from pymc_statespace_filters.model import StateSpaceModel

_ONE_PARTICLE = 1e-10  # 1 - sum w^2 below this: one particle has all the weight, no covariance


_LIKELIHOODS = ("predictive", "weights", "as_printed")
_PREDICTIVE, _WEIGHTS, _AS_PRINTED = range(3)


class _Scratch(NamedTuple):
    """Of one update: moments of the forecast, and what the densities of Eq. 4.36 need."""

    moments: tuple
    w_equal: np.ndarray
    log_prior: np.ndarray
    log_proposal: np.ndarray
    density: tuple


@pasted
def _workspace(system, n_members, width, settings):
    n, p, N, n_free = system.n, system.p, n_members, system.free.size
    moments = (np.empty(n), np.empty(p), np.empty((n, p)), np.empty((p, p)))
    density = density_workspace(n_free, width)
    scratch = _Scratch(moments, np.empty(N), np.empty(N), np.empty(N), density)
    return np.int64(settings[2]), scratch


@pasted
def _update(system, j, k, t, d, noise, members, work):
    X, D, X_f, w, log_w, log_p, alive = members
    likelihood, scratch = work

    # Simulated observations and previous weights, of the particles that are alive
    observe(system, k, t, observation_normals(noise, j, k), noise.sizes.width, X, D)  # Eq. 4.29
    if mark_finite(X, D, alive) == 0:
        return -np.inf, 0.0, NO_FINITE_MEMBER
    for i in range(w.size):
        log_w[i] = log_w[i] if alive[i] else -np.inf
    log_alive = normalise(log_w, w)
    if log_alive == -np.inf:
        return -np.inf, 0.0, ZERO_WEIGHTS

    # Predicted density of the observation, then proposal and weights
    log_density(system, k, t, d, X, log_p)
    log_forecast = log_alive + log_sum(log_w, log_p)
    copy_members(X, X_f)
    as_printed = likelihood == _AS_PRINTED
    if not _move(system, k, t, d, members, scratch, as_printed):  # Eqs. 4.30-4.36
        copy_members(X_f, X)
        log_density(system, k, t, d, X, log_p)
        for i in range(w.size):
            log_w[i] += log_p[i]  # Eq. 4.28
    log_total = log_alive + normalise(log_w, w)  # Eq. 4.37
    if likelihood == _PREDICTIVE:
        increment = log_forecast  # Eq. 4.42 without its double count
    elif likelihood == _WEIGHTS:
        increment = log_total  # log of the mean unnormalised weight: importance sampling
    else:
        increment = log_sum(log_w, log_p)  # Eq. 4.42 to the letter
    if not (np.isfinite(increment) and np.isfinite(log_total)):
        return -np.inf, 0.0, ZERO_WEIGHTS
    return increment, effective_number(w), NONE  # Eq. 4.43


@pasted
def _move(system, k, t, d, members, scratch, keeps_previous):
    """Nudge X; leave the unnormalised weights in log_w and p(d | x^a) in log_p.

    ``keeps_previous`` keeps the factor w_{d(j)-1,i} of Eq. 4.36. False, with log_w as it was, if no
    proposal can be built.
    """
    X, D, X_f, w, log_w, log_p, alive = members
    moments, w_equal, log_prior, log_proposal, density = scratch
    free, n, n_free = system.free, system.n, system.free.size
    P, x_mean = np.empty((n, n)), np.empty(n)
    H_f, H_a = np.empty((n_free, n_free)), np.empty((n_free, n_free))
    spreads_f, spreads_a = np.empty(n_free, np.bool_), np.empty(n_free, np.bool_)

    # Nudge
    if spread_factor(w) < _ONE_PARTICLE:
        return False
    if not forecast_moments(w, X, D, d, moments):  # Eqs. 4.30-4.33
        return False
    nudge(d, D, alive, free, moments, X)  # Eqs. 4.34-4.35

    # Bandwidths
    n_alive = count_true(alive)
    equal_weights(alive, n_alive, w_equal)
    n_effective = effective_number(w)
    if not (
        scott_bandwidth(w_equal, float(n_alive), X, free, x_mean, P, H_a, spreads_a)  # Eq. 4.38
        and scott_bandwidth(w, n_effective, X_f, free, x_mean, P, H_f, spreads_f)  # Eq. 4.39
        and _agree(spreads_a, spreads_f)
    ):
        return False

    # Weights (Eq. 4.36)
    log_density(system, k, t, d, X, log_p)
    log_kernel_density(w, X_f, X, free, H_f, spreads_f, density, log_prior)
    log_kernel_density(w_equal, X, X, free, H_a, spreads_a, density, log_proposal)
    for i in range(w.size):
        share = log_w[i] if keeps_previous else -math.log(n_alive)
        log_weight = share + log_p[i] + (log_prior[i] - log_proposal[i])
        log_w[i] = log_weight if alive[i] else -np.inf
    return True


@compiled
def _agree(spreads_a, spreads_f):
    """Whether two ensembles spread in the same directions."""
    for a in range(spreads_a.size):
        if spreads_a[a] != spreads_f[a]:
            return False
    return True


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
    entry: ClassVar[Entry] = filter_entry(
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
