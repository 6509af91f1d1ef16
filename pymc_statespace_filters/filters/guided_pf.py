"""Guided particle filter: particles are moved towards what the rest of the record says.

In front of every observation particles are resampled by w psi, the weight given the whole record;
on the way to the next one their noise is drawn from N(a - K x, R R') instead of N(0, I); weights
are divided by both. See `ensemble.guide` for psi and the gains.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numba import carray

from pymc_statespace_filters.compiler.native.cache_key import digest
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint
from pymc_statespace_filters.compiler.native.jit import njit_internal
from pymc_statespace_filters.compiler.numerics.normals import FILL_NORMALS
from pymc_statespace_filters.filters.ensemble.callbacks import (
    ENDED,
    FORECAST,
    RESAMPLED,
    UPDATED,
    emit,
)
from pymc_statespace_filters.filters.ensemble.guide import Record, make_guide
from pymc_statespace_filters.filters.ensemble.kalman_update import mark_finite
from pymc_statespace_filters.filters.ensemble.loop import (
    FILTER_ARGUMENTS,
    N_LEADING,
    Members,
    n_sums,
    new_members,
    noise_of_rank,
)
from pymc_statespace_filters.filters.ensemble.noise import (
    initial_rows,
    process_normals,
    resampling_normals,
)
from pymc_statespace_filters.filters.ensemble.particle_filter import ParticleFilter
from pymc_statespace_filters.filters.ensemble.partition import RankLayout
from pymc_statespace_filters.filters.ensemble.reductions import count, local_partition
from pymc_statespace_filters.filters.ensemble.resampling import resample, resampler
from pymc_statespace_filters.filters.ensemble.weights import normalise_weights
from pymc_statespace_filters.filters.outcomes import (
    NO_FINITE_MEMBER,
    NONE,
    ZERO_WEIGHTS,
    is_missing,
)
from pymc_statespace_filters.filters.system_table import (
    initialise,
    log_density,
    propagate_guided,
    read_system,
)

_NUMBER_BYTES = 8


class _Particles(NamedTuple):
    """Members, with what guided moves add to them.

    ``log_ratio`` (N,) follows the states in memory: the log density ratios of moves since they were
    last added to the weights. ``log_det`` (1,) is their common term. ``log_v`` and ``v`` (N,) are
    the weights times psi.
    """

    members: Members
    log_ratio: np.ndarray
    log_det: np.ndarray
    log_v: np.ndarray
    v: np.ndarray
    start: np.ndarray


@njit_internal
def _particles(n, p, local):
    rows = np.empty((n + 1, local.size))
    rows[n] = 0.0
    members = new_members(rows[:n], p, local)
    N = local.size
    return _Particles(
        members, rows[n], np.zeros(1), np.empty(N), np.empty(N), np.empty((n, local.width))
    )


@njit_internal
def _start(system, guide, given, particles, local):
    """Draw the states at step 0 from normals (n, width), shifted by the guide."""
    n, N = system.n, local.size
    shifted = particles.start
    place = 1 + n + n * n
    for r in range(n):
        for i in range(N):
            value = guide.start[1 + r]
            for c in range(r, n):
                value += guide.start[place + c - r] * given[c, i]
            shifted[r, i] = value
            particles.log_ratio[i] += 0.5 * (given[r, i] * given[r, i] - value * value)
        place += n - r
    particles.log_det[0] = guide.start[0]
    initialise(system, shifted.ctypes.data, local.width, particles.members.X)


@njit_internal
def _weigh_moves(particles):
    """Add the density ratios of the moves to the weights."""
    log_w, log_ratio = particles.members.log_w, particles.log_ratio
    for i in range(log_w.size):
        log_w[i] += log_ratio[i] + particles.log_det[0]
        log_ratio[i] = 0.0
    particles.log_det[0] = 0.0


@njit_internal
def _log_psi(guide, j, k, X, out):
    """Write log psi of every particle after observation j, without its constant."""
    n, N = X.shape
    x, psi, place = guide.path[k], guide.psi[j], n
    for i in range(N):
        out[i] = 0.0
    for a in range(n):
        for b in range(a):
            for i in range(N):
                out[i] -= psi[place] * (X[a, i] - x[a]) * (X[b, i] - x[b])
            place += 1
        for i in range(N):
            out[i] += (psi[a] - 0.5 * psi[place] * (X[a, i] - x[a])) * (X[a, i] - x[a])
        place += 1


@njit_internal
def _update(system, j, k, t, d, particles, local):
    """Weight the particles by the density of the observation (Eq. 4.28)."""
    members = particles.members
    X, log_w, alive = members.X, members.log_w, members.alive
    mark_finite(X, X, alive)
    log_density(system, k, t, d, X, members.log_p)
    for i in range(alive.size):
        log_w[i] = log_w[i] + members.log_p[i] if alive[i] else -np.inf
    increment, _ = normalise_weights(log_w, members.w, local)
    if increment == -np.inf:
        return increment, NO_FINITE_MEMBER if count(alive, local) == 0.0 else ZERO_WEIGHTS
    return increment, NONE


@njit_internal
def _look_ahead(guide, j, k, particles, local):
    """Weigh the particles by psi; return the log of the sum of w psi and its effective number."""
    members, log_v = particles.members, particles.log_v
    _log_psi(guide, j, k, members.X, log_v)
    for i in range(log_v.size):
        log_v[i] = members.log_w[i] + log_v[i] if members.alive[i] else -np.inf
    return normalise_weights(log_v, particles.v, local)


@njit_internal
def _resample(guide, j, k, log_total, resampling, z, particles, local):
    """Draw particles in proportion to w psi, whose sum is given, and divide their weights by it."""
    log_w, log_psi = particles.members.log_w, particles.log_v
    resample(resampling, z, particles.v, particles.members.X, local)
    _log_psi(guide, j, k, particles.members.X, log_psi)
    for i in range(log_w.size):
        log_w[i] = log_total - math.log(local.n_members) - log_psi[i]


@njit_internal
def _move(system, guide, record, noise, first, last, particles, local):
    """Move the particles from one step to another."""
    X, gains, log_det = particles.members.X, guide.gains, 0.0
    row = np.int64(gains.ctypes.data) + _NUMBER_BYTES * (first * gains.shape[1] + 1)
    for k in range(first, last):
        t, z = record.t0 + k * system.dt, process_normals(noise, k)
        propagate_guided(system, k, t, z, local.width, X, row)
        row += _NUMBER_BYTES * gains.shape[1]
        log_det += gains[k, 0]
    particles.log_det[0] += log_det


@njit_internal
def _emit_forecast(callback, j, k, particles, nothing, ancestors):
    """Show the particles with the weights that their moves have left them."""
    if callback[0] == 0:
        return
    members, log_v = particles.members, particles.log_v
    for i in range(log_v.size):
        log_v[i] = members.log_w[i] + particles.log_ratio[i] + particles.log_det[0]
    shown = Members(
        X=members.X, D=members.D, X_f=members.X_f, w=members.w, log_w=log_v, log_p=members.log_p,
        alive=members.alive,
    )  # fmt: skip
    emit(callback, FORECAST, j, k, shown, nothing, ancestors)


def _run(
    table, dt, theta, n_theta, inputs, n_rows, settings, steps, n_observations, observed, t0,
    seed, normals, n_normals, order, callback, integers, reals, rank, n_ranks, exchange,
    terms, n_effective, health,
):  # fmt: skip
    given = carray(settings, (N_LEADING + 2,))
    system = read_system(table, dt, theta, n_theta, inputs, n_rows)
    layout = RankLayout(rank, n_ranks, exchange)
    local = local_partition(layout, int(given[0]), n_sums(system))
    at = carray(steps, (n_observations,))
    record = Record(at, carray(observed, (n_observations, system.p)), t0)
    out, state = carray(terms, (n_observations,)), carray(health, (3,))
    numbers = carray(n_effective, (n_observations,))
    noise = noise_of_rank(seed, carray(normals, (n_normals,)), given, at, local)
    scheme = int(given[N_LEADING + 1])
    resampling = resampler(given[N_LEADING], scheme, order, system.n, local)
    particles, guide = _particles(system.n, system.p, local), make_guide(system, record)
    members, to = particles.members, (callback, integers, reals)
    state[0], state[1], state[2] = given[0], NONE, -1
    nothing, ancestors = np.empty(0), resampling.ancestors
    k = np.int64(0)
    _start(system, guide, initial_rows(noise), particles, local)
    _emit_forecast(to, -1, k, particles, nothing, ancestors)
    for j in range(n_observations):
        while k < at[j]:
            until = at[j] if callback == 0 else k + 1
            _move(system, guide, record, noise, k, until, particles, local)
            k = until
            _emit_forecast(to, j, k, particles, nothing, ancestors)
        if is_missing(record.observed, j):
            out[j] = 0.0
            continue
        _weigh_moves(particles)
        d = record.observed[j]
        increment, failure = _update(system, j, k, t0 + k * dt, d, particles, local)
        if failure != NONE:
            state[0], state[1], state[2], numbers[j] = 0.0, failure, j, 0.0
            break
        out[j] = increment
        log_total, numbers[j] = _look_ahead(guide, j, k, particles, local)
        state[0] = min(state[0], numbers[j])
        emit(to, UPDATED, j, k, members, d, ancestors)
        if resampling.always or numbers[j] < resampling.threshold:
            z = resampling_normals(noise, j, k)
            _resample(guide, j, k, log_total, resampling, z, particles, local)
            emit(to, RESAMPLED, j, k, members, nothing, ancestors)
    if state[1] == NONE:
        emit(to, ENDED, n_observations, k, members, nothing, ancestors)


@dataclass(frozen=True)
class GuidedPF(ParticleFilter):
    """Guided particle filter: particles move towards what the rest of the record says.

    Its estimate of the likelihood (not of the log-likelihood) has the exact likelihood of the
    discretised system as its mean, for any number of particles, as that of `BootstrapPF`. It needs
    far fewer: a bootstrap filter finds out at an observation that its particles are in the wrong
    place, this one has moved them there, by noise from a linearised smoother and with weights that
    undo the shift. On a linear system with Gaussian noise the estimate is the exact likelihood for
    any seed. Use it where sensors are precise, observations surprise, or noise enters through the
    velocity alone; 100 particles are a good first number.

    Parameters
    ----------
    n_particles : int
        Number N of particles, at least 2.
    resample_below : float
        Resample after an observation if the effective number of particles given the whole record is
        below this fraction of N: 1 resamples at every observation, 0 never.
    resampling : {"systematic", "multinomial", "sorted"}
        Resampling scheme, see `BootstrapPF`.

    Raises
    ------
    ModelError
        If ``n_particles`` is not an integer of at least 2, ``resample_below`` is not between 0 and
        1, or ``resampling`` is not one of the three names.

    Notes
    -----
    The noise q of a step is drawn from the normal distribution that it has given the state and all
    later observations, in a linear system of least mean square error along the record. That system
    is computed once per evaluation, from the equations and their Jacobians, in a few passes of an
    extended Kalman smoother; the gains are the same for all particles. An observation density that
    is not Gaussian enters by its score and information. Where the linear system says little, such
    as in front of a jump over a barrier, weights are uneven but the estimate is right in the mean.
    Where two states explain the record equally well, as with a sensor of ``abs(x)``, particles
    follow one of them: most estimates are then too low, a few far too high. Use `BootstrapPF`.

    Terms of single observations are noisier than their sum, because particles are where the whole
    record wants them.

    A particle with a non-finite state has weight zero.

    References
    ----------
    Whitaker, Golightly, Boys and Sherlock (2017), Statistics and Computing 27, 885-900: proposals
    of noise given the next observation. Mider, Schauer and van der Meulen (2021), Electronic
    Journal of Statistics 15, 4295-4342: guides from the whole record. Garcia-Fernandez, Svensson
    and Sarkka (2017), IEEE Transactions on Automatic Control 62, 2056-2063: linear equations of
    least mean square error along a smoother.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[0.1]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.2]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> record = {"observed": [0.3, 1.2], "steps": [0, 3]}
    >>> terms = psf.log_likelihood(system, psf.GuidedPF(10), {"a": 0.9}, **record)
    >>> exact = psf.log_likelihood(system, psf.EKF(), {"a": 0.9}, **record)
    >>> bool(abs(terms.sum() - exact.sum()) < 1e-9)
    True
    """

    unbiased: ClassVar[bool] = True
    entry: ClassVar[EntryPoint] = EntryPoint(
        _run, FILTER_ARGUMENTS, "guided_pf", digest("guided_pf"), needs=(FILL_NORMALS,)
    )
    resample_below: float = 0.5

    def functions(self) -> Sequence[str]:
        """Return the names of the system's functions that the entry calls."""
        guide = ("observation_information", "follow", "look_back", "start_back")
        return "initialise", "log_density", "propagate_guided", *guide
