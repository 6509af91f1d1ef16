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
from ..compiler.native.jit import inline_always, njit_internal
from ..compiler.native.plan import Plan
from ..errors import ModelError
from .bootstrap import observe
from .ensemble.defence import choose_unguided, least_share, share_at_start
from .ensemble.evaluation import new_members, restore
from .ensemble.guide import initial_law, law_of_particles, make_guide
from .ensemble.guided_moves import (
    begin_interval,
    draw_start,
    guided_particles,
    look_ahead,
    move,
    resample_ahead,
    show_forecast,
    weigh_moves,
)
from .ensemble.guided_predictions import copy_again, move_copies, start_copies
from .ensemble.kalman_update import mark_finite
from .ensemble.loop import Outcome, Plain, failed, member_filter
from .ensemble.particle_filter import ParticleFilter
from .ensemble.pilot import chosen_for_pilot, judge
from .ensemble.weights import normalise_weights
from .outcomes import NONE
from .plan import PLAN
from .protocol import System


@njit_internal
def _start(call):
    """Make the guide of the rows given; draw particles, or weigh those of a state by psi."""
    system, record, local = call.system, call.record, call.local
    members, goes_on = new_members(system.n, system.p, local), call.state.size > 0
    if goes_on:
        k = restore(call, members)
        mark_finite(members.X, members.X, members.alive)
        normalise_weights(members.log_w, members.w, local)
        beginning = law_of_particles(system, k, members.w, members.X, local)
        of_pilot = chosen_for_pilot(members.w, members.X, local)
    else:
        k, beginning, of_pilot = np.int64(0), initial_law(system), np.empty((system.n, 0))
    guide, shares = make_guide(system, record, beginning), np.zeros(record.steps.size + 1)
    if not call.plan[PLAN.is_linear]:
        judge(call, guide, observe, k, of_pilot, shares)
        for j in range(record.steps.size):
            shares[j] = max(shares[j], least_share(guide, j))
    particles = guided_particles(call, members, guide, shares)
    if goes_on:
        _resample(call, -1, k, look_ahead(call, 0, k, particles), particles)
        return k, particles
    choose_unguided(shares[0], 0.0, local.first, particles.unguided)
    share = particles.ahead[0] = share_at_start(shares[0], local.n_members)
    draw_start(call, guide, share, particles)
    if call.observer[0] != 0:
        show_forecast(call, -1, k, particles)
        start_copies(call, particles)
    return k, particles


@inline_always
def _advance(call, j, k, last, particles):
    """Move up to the row, step by step if somebody looks."""
    if call.observer[0] == 0:
        move(call, k, last, particles)
        return
    for step in range(k, last):
        move(call, step, step + 1, particles)
        show_forecast(call, j, step + 1, particles)
        move_copies(call, j, step + 1, particles)


@inline_always
def _observe(call, j, k, particles):
    """Divide the weights by what the guide has done, weigh by the observation, and look ahead."""
    weigh_moves(particles, particles.members.log_w)
    begin_interval(particles)
    found = observe(call, j, k, Plain(particles.members))
    if found.failure != NONE:
        return failed(found.failure)
    n_effective = look_ahead(call, j + 1, k, particles)
    return Outcome(found.increment, n_effective, n_effective, NONE)


@inline_always
def _resample(call, j, k, n_weighted, particles):
    """Resample by w psi in front of the rows ahead; a state is left without it."""
    resampling = call.resampling
    is_few = resampling.always or particles.ahead[0] > 0.0 or n_weighted < resampling.threshold
    is_few &= j + 1 < call.record.steps.size
    if is_few:
        resample_ahead(call, j + 1, k, particles)
    if call.observer[0] != 0:
        copy_again(particles)
    return is_few


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

    A run that goes on from a state is guided by the rows that it is given, from its particles on.
    The estimate of a record in parts is unbiased too, with more noise the shorter the parts are;
    row by row, as in ``sample_smc(data="sequential")``, it looks ahead by one row.

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
    needs_record_ahead: ClassVar[bool] = True
    entry: ClassVar[EntryPoint] = member_filter(
        "guided_pf", _observe, start=_start, advance=_advance, resample=_resample
    )
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
