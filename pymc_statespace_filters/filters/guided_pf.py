"""Guided particle filter: particles are moved towards what the rest of the record says.

In front of every observation particles are resampled by w psi, the weight given the whole record;
on the way to the next one their noise is drawn from N(a - K x, R R') instead of N(0, I); weights
are divided by both. See `ensemble.guide` for psi and the gains, `ensemble.defence` for the
particles that stay unguided where the guide is in doubt, and `ensemble.pilot` for how many do.
"""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

import numpy as np

from ..compiler.native.entry_point import EntryPoint
from ..compiler.native.jit import njit_internal
from ..compiler.native.plan import NORMALS, Plan
from ..compiler.numerics.normals import FILL_NORMALS
from ..errors import ModelError
from .bootstrap import update
from .calls import OK, likelihood_entry
from .ensemble.callbacks import ENDED, RESAMPLED, UPDATED, emit
from .ensemble.defence import choose_unguided, least_share, place_of_unguided, share_at_start
from .ensemble.guide import make_guide
from .ensemble.guided_moves import (
    begin_interval,
    emit_forecast,
    guided_particles,
    look_ahead,
    move,
    resample_ahead,
    start,
    weigh_moves,
)
from .ensemble.guided_predictions import copy_again, predict, start_copies
from .ensemble.loop import N_LEADING, n_sums, noise_of_rank, observer_of, rank_of
from .ensemble.noise import initial_rows, resampling_normals
from .ensemble.particle_filter import ParticleFilter
from .ensemble.pilot import judge
from .ensemble.reductions import local_partition
from .ensemble.resampling import resampler
from .outcomes import NONE, is_missing
from .plan import PLAN, read_system, settings_of
from .protocol import System


@njit_internal
def _unguided_shares(plan, system, record, guide):
    """The share (J + 1,) of unguided particles before every observation and after the last."""
    J = record.steps.size
    shares = np.zeros(J + 1)
    if plan[PLAN.is_linear]:
        return shares
    judge(system, record, guide, update, shares)
    for j in range(J):
        shares[j] = max(shares[j], least_share(guide, j))
    return shares


@njit_internal
def _evaluate(plan, record, request, seed, to):
    given, steps, dt = settings_of(plan), record.steps, plan.view(np.float64)[PLAN.dt]
    system = read_system(plan, record.theta, record.inputs)
    local = local_partition(rank_of(request), int(given[0]), n_sums(system))
    noise, fits = noise_of_rank(seed, request, given, steps, local)
    if not fits:
        return NORMALS
    if system.failure != NONE:
        to.health[0], to.health[1], to.health[2] = 0.0, system.failure, 0.0
        return OK
    scheme = int(given[N_LEADING + 1])
    resampling = resampler(given[N_LEADING], scheme, plan[PLAN.order], system.n, local)
    particles = guided_particles(system.n, system.m, system.p, local)
    guide = make_guide(system, record)
    members, observer, health = particles.members, observer_of(request), to.health
    health[0], health[1], health[2] = given[0], NONE, -1
    nothing, ancestors = np.empty(0), resampling.ancestors
    k = np.int64(0)
    shares = _unguided_shares(plan, system, record, guide)
    choose_unguided(shares[0], 0.0, local.first, particles.unguided)
    share = share_at_start(shares[0], local.n_members)
    start(system, guide, initial_rows(noise), share, particles, local)
    copies = start_copies(system, noise, members, observer, local)
    emit_forecast(observer, -1, k, share, particles, nothing, ancestors)
    predict(system, record, noise, -1, k, copies, observer, nothing, ancestors, local)
    for j in range(steps.size):
        while k < steps[j]:
            until = steps[j] if observer[0] == 0 else k + 1
            move(system, guide, record, noise, k, until, share, particles, local)
            k = until
            emit_forecast(observer, j, k, share, particles, nothing, ancestors)
            predict(system, record, noise, j, k, copies, observer, nothing, ancestors, local)
        if is_missing(record.observed, j):
            to.terms[j] = 0.0
            continue
        weigh_moves(particles, share, members.log_w)
        begin_interval(particles)
        d = record.observed[j]
        found = update(system, j, k, record.t0 + k * dt, d, noise, members, local, ())
        if found.failure != NONE:
            health[0], health[1], health[2], to.n_effective[j] = 0.0, found.failure, j, 0.0
            break
        to.terms[j] = found.increment
        share = shares[j + 1]
        log_total, to.n_effective[j] = look_ahead(guide, j, k, share, particles, local)
        health[0] = min(health[0], to.n_effective[j])
        emit(observer, UPDATED, j, k, members, d, ancestors)
        if resampling.always or share > 0.0 or to.n_effective[j] < resampling.threshold:
            z = resampling_normals(noise, j, k)
            choose_unguided(share, place_of_unguided(z), local.first, particles.unguided)
            resample_ahead(guide, j, k, log_total, resampling, z, share, particles, local)
            emit(observer, RESAMPLED, j, k, members, nothing, ancestors)
        copy_again(members, copies, observer)
    if health[1] == NONE:
        emit(observer, ENDED, steps.size, k, members, nothing, ancestors)
    return OK


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
        below this fraction of N: 1 resamples at every observation, 0 only in front of an interval
        in which particles are unguided, where all settings do.
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
    is computed once per evaluation, from the equations and their Jacobians, in a few passes of a
    Kalman smoother; the gains are the same for all particles. An observation density that
    is not Gaussian enters by its score and information. Where the linear system says little, such
    as in front of a jump over a barrier, weights are uneven but the estimate is right in the mean.

    In intervals over which the linear system may be wrong a share of the particles, a tenth to nine
    tenths, moves unguided; no weight of such an interval is above the inverse of the share. The
    share is larger where 128 unguided particles, which run along the record first, find paths that
    explain it as well as the guide does and that guided particles would miss: the other sign behind
    a sensor of ``abs(x)``, the other side of a threshold. It is nine tenths everywhere if the
    sensor folds between these particles. They have noise of their own, which is always the same,
    and nothing else of them enters the estimate. A system that is linear is spared them. On records
    with two explanations the filter is then about as good as a `BootstrapPF` of as many particles,
    but no better, and slower: use that one where a sensor folds. What 128 unguided particles do not
    find, such as a narrow way under a precise sensor, can still be missed.

    Particles are where the whole record wants them, so that a part of its terms is no estimate of
    those rows: a start of which nothing is known makes the first terms too low and the others too
    high. `compute_log_likelihood` and `leave_future_out` take differences of estimates of shorter
    records, ``score_from`` is refused. Filtered states and predictions of observations are too
    narrow where later rows say far more about the state; smoothed states are not.

    A particle with a non-finite state has weight zero.

    References
    ----------
    Hesterberg (1995), Technometrics 37, 185-194: defensive mixtures.
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
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.5]],
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
    resumes: ClassVar[bool] = False
    needs_record_ahead: ClassVar[bool] = True
    entry: ClassVar[EntryPoint] = likelihood_entry("guided_pf", _evaluate, needs=(FILL_NORMALS,))
    _: KW_ONLY
    resample_below: float = 0.5

    def check(self, system: System) -> None:
        """Raise if the noise or the start has no derivative by a normal, or as `ParticleFilter`."""
        super().check(system)
        if system.gaussian is not system:
            raise ModelError(
                "GuidedPF moves particles by Gaussian noise and from a Gaussian start, got other "
                "distributions in process_dist or initial_dist, or steps of Milstein"
            )

    def functions(self) -> Sequence[str]:
        """Return the names of the system's functions that the entry calls."""
        guide = ("observation_information", "follow", "look_back", "start_back")
        return "initialise", "log_density", "propagate_guided", *guide

    def plan(
        self, system: System, run: EntryPoint, functions: Sequence[str], **others: int | EntryPoint
    ) -> Plan:
        """Return the plan of a function that reads the settings of this filter."""
        return super().plan(system, run, functions, is_linear=int(system.is_linear), **others)
