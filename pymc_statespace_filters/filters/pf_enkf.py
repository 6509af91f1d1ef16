"""Particle filter with an ensemble Kalman proposal (thesis, section 4.4, Eqs. 4.29-4.44)."""

import math
from dataclasses import KW_ONLY, dataclass

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
    density_workspace,
    log_kernel_density,
    scott_bandwidth,
)
from pymc_statespace_filters.filters._loop import filter_loop
from pymc_statespace_filters.filters._random import OBSERVATION, fill_normals, padded
from pymc_statespace_filters.filters._resampling import POINTS, choose_ancestors, copy_ancestors
from pymc_statespace_filters.filters._weights import effective_number, log_sum, normalise
from pymc_statespace_filters.filters.bootstrap import BootstrapPF

_ONE_PARTICLE = 1e-10  # 1 - sum w^2 below this: one particle has all the weight, no covariance


@compiled
def _predictive(log_forecast, log_total, log_w, log_p):
    """Sum of previous weights times p(d | x^f): the log of Eq. 4.42 without its double count."""
    return log_forecast


@compiled
def _mean_weight(log_forecast, log_total, log_w, log_p):
    """Log of the mean unnormalised weight, an importance sampling estimate."""
    return log_total


@compiled
def _as_printed(log_forecast, log_total, log_w, log_p):
    """Sum of the new weights times p(d | x^a): the log of Eq. 4.42 to the letter."""
    return log_sum(log_w, log_p)


_LIKELIHOODS = {"predictive": _predictive, "weights": _mean_weight, "as_printed": _as_printed}


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
    resampling : {"systematic", "multinomial"}
        Scheme; "multinomial" is the thesis's, "systematic" has less noise.
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

    def __post_init__(self) -> None:
        object.__setattr__(self, "n_particles", check_count("n_particles", self.n_particles))
        fraction = check_fraction("resample_below", self.resample_below)
        object.__setattr__(self, "resample_below", fraction)
        check_choice("resampling", self.resampling, POINTS)
        check_choice("likelihood", self.likelihood, _LIKELIHOODS)

    def kernel(self, machine):
        """Compile the filter for one system; see ``_loop.filter_loop`` for what is returned."""
        if machine.observe is None or machine.free.size == 0:
            # Nothing to nudge by, or nothing to nudge: every update is the bootstrap filter's.
            return BootstrapPF(
                self.n_particles, resample_below=self.resample_below, resampling=self.resampling
            ).kernel(machine)
        N, n, p, r = self.n_particles, machine.n, machine.p, machine.r
        observe, log_density = machine.observe, machine.log_density
        move = _compile_move(machine, N, self.likelihood == "as_printed")
        likelihood = _LIKELIHOODS[self.likelihood]
        draw_points = POINTS[self.resampling]
        always, threshold = self.resample_below == 1.0, self.resample_below * N
        width, n_free, log_N = padded(N), machine.free.size, math.log(N)

        @pasted
        def workspace():
            noise, simulated, forecast = np.empty((r, width)), np.empty((p, N)), np.empty((n, N))
            weights = (np.empty(N), np.empty(N), np.empty(N), np.empty(N, np.bool_))
            weights[1][:] = -log_N
            moments = (np.empty(n), np.empty(p), np.empty((n, p)), np.empty((p, p)))
            densities = (np.empty(N), np.empty(N), np.empty(N), density_workspace(n_free, width))
            return noise, simulated, forecast, weights, (moments, densities), np.empty(N + 1)

        @pasted
        def update(c, inputs, k, t, d, seed, X, work):
            Z, D, X_f, weights, scratch, points = work
            w, log_w, log_p, alive = weights

            # Simulated observations and previous weights, of the particles that are alive
            fill_normals(seed, OBSERVATION, k, Z)
            observe(c, inputs, k, t, Z, X, D)  # Eq. 4.29
            if mark_finite(X, D, alive) == 0:
                return -np.inf, 0.0, NO_FINITE_MEMBER
            for i in range(N):
                log_w[i] = log_w[i] if alive[i] else -np.inf
            log_alive = normalise(log_w, w)
            if log_alive == -np.inf:
                return -np.inf, 0.0, ZERO_WEIGHTS

            # Predicted density of the observation, then proposal and weights
            log_density(c, inputs, k, t, d, X, log_p)
            log_forecast = log_alive + log_sum(log_w, log_p)
            copy_members(X, X_f)
            if not move(c, inputs, k, t, d, D, X_f, X, weights, scratch):  # Eqs. 4.30-4.36
                copy_members(X_f, X)
                log_density(c, inputs, k, t, d, X, log_p)
                for i in range(N):
                    log_w[i] += log_p[i]  # Eq. 4.28
            log_total = log_alive + normalise(log_w, w)  # Eq. 4.37
            increment = likelihood(log_forecast, log_total, log_w, log_p)
            if not (np.isfinite(increment) and np.isfinite(log_total)):
                return -np.inf, 0.0, ZERO_WEIGHTS
            n_effective = effective_number(w)  # Eq. 4.43

            # Resampling
            if always or n_effective < threshold:
                ancestors = np.empty(N, np.int64)
                draw_points(seed, k, points)
                choose_ancestors(w, points, ancestors)
                copy_ancestors(ancestors, X, X_f)
                log_w[:] = -log_N
            return increment, n_effective, NONE

        return filter_loop(machine, N, workspace, update)


@compiled
def _agree(spreads_a, spreads_f):
    """Whether two ensembles spread in the same directions."""
    for a in range(spreads_a.size):
        if spreads_a[a] != spreads_f[a]:
            return False
    return True


def _compile_move(machine, N, keeps_previous):
    """Compile the proposal and its weights.

    ``keeps_previous`` keeps the factor w_{d(j)-1,i} of Eq. 4.36.
    """
    n, free, log_density = machine.n, machine.free, machine.log_density
    n_free = free.size

    @pasted
    def move(c, inputs, k, t, d, D, X_f, X, weights, scratch):
        """Nudge X; leave the unnormalised weights in log_w and p(d | x^a) in log_p.

        False, with log_w as it was, if no proposal can be built.
        """
        w, log_w, log_p, alive = weights
        moments, (w_equal, log_prior, log_proposal, density_work) = scratch
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
        log_density(c, inputs, k, t, d, X, log_p)
        log_kernel_density(w, X_f, X, free, H_f, spreads_f, density_work, log_prior)
        log_kernel_density(w_equal, X, X, free, H_a, spreads_a, density_work, log_proposal)
        for i in range(N):
            share = log_w[i] if keeps_previous else -math.log(n_alive)
            log_weight = share + log_p[i] + (log_prior[i] - log_proposal[i])
            log_w[i] = log_weight if alive[i] else -np.inf
        return True

    return move
