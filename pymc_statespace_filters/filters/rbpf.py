"""Rao-Blackwellised particle filter: particles carry regimes, each with a Kalman filter.

Particles move as those of any filter, each with its own mean and covariance, up to the last step in
front of an observation, which tries all that may happen. See `regimes.particles` for both.
"""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import ClassVar

import numpy as np

from ..compiler.lowering.compiled_system import compile_system
from ..compiler.native.entry_point import EntryPoint
from ..compiler.native.jit import copy_into, njit_internal
from ..compiler.native.plan import NORMALS, STATE, Plan
from ..compiler.native.planned_function import PlannedFunction
from ..compiler.numerics.normals import FILL_NORMALS, padded
from .calls import OK, likelihood_entry, state_given
from .ekf import EKF
from .ensemble.backward_simulation import STORE
from .ensemble.callbacks import FORECAST, RESAMPLED, UPDATED, emit
from .ensemble.failures import failure_of_all
from .ensemble.kalman_update import mark_finite
from .ensemble.loop import (
    N_LEADING,
    Members,
    begin,
    finish,
    new_members,
    noise_of_rank,
    observer_of,
    rank_of,
)
from .ensemble.noise import NoiseSizes, process_normals, resampling_normals
from .ensemble.particle_filter import ParticleFilter
from .ensemble.reductions import local_partition
from .ensemble.resampling import check_sortable, resample_if_few, resampler, smooth_resampling
from .ensemble.summaries import LAST_EVENTS
from .ensemble.weights import normalise_weights
from .iplf import IPLF
from .outcomes import NONE, is_missing
from .plan import NULL, PLAN, call_members, make_plan, propagate, read_system, settings_of
from .protocol import System
from .regimes.checks import check_hybrid, check_inner
from .regimes.hybrid import hybrid_of
from .regimes.moves import moves_of_parts
from .regimes.particle_states import (
    RUN_OF_MIXTURE,
    SMOOTH_MIXTURE,
    STATES_OF_MIXTURE,
    SUMMARISE_MIXTURE,
)
from .regimes.particles import HybridParticles, hybrid_particles
from .signatures import RUN, STATES
from .state_law import StateLaw, weighted_columns
from .ukf import UKF


@njit_internal
def _seen_at(system, d, k, t):
    """An observation, the inputs at its step, and its time, as a vector."""
    n_inputs = system.inputs.shape[1]
    seen = np.empty(d.size + n_inputs + 1)
    copy_into(seen[: d.size], d)
    for i in range(n_inputs):
        seen[d.size + i] = system.inputs[k, i] if k < system.inputs.shape[0] else np.nan
    seen[d.size + n_inputs] = t
    return seen


@njit_internal
def _weigh(members, log_density, local):
    """Add the log-densities of an observation to the weights; their sum and effective number."""
    mark_finite(members.X, members.X, members.alive)
    log_w = members.log_w
    for i in range(log_w.size):
        members.alive[i] &= log_w[i] > -np.inf
        log_w[i] = log_w[i] + log_density[i] if members.alive[i] else -np.inf
    return normalise_weights(log_w, members.w, local)


@njit_internal
def _show_forecast(observer, system, j, k, t, noise, local, members, nothing, ancestors):
    """Show copies of the particles that move without the observation at the end of the step."""
    if observer[0] == 0:
        return
    copies = Members(
        X=members.X.copy(), D=members.D, X_f=members.X_f, w=members.w, log_w=members.log_w,
        log_p=members.log_p, alive=members.alive,
    )  # fmt: skip
    propagate(system, k, t, process_normals(noise, k), local.width, copies.X)
    emit(observer, FORECAST, j, k + 1, copies, nothing, ancestors)


@njit_internal
def _evaluate(plan, record, request, seed, to):
    given, steps, t0 = settings_of(plan), record.steps, record.t0
    system = read_system(plan, record.theta, record.inputs)
    local = local_partition(rank_of(request), int(given[0]), 8)
    noise, fits = noise_of_rank(seed, request, given, steps, local)
    if not fits:
        return NORMALS
    resampling = resampler(
        given[N_LEADING], int(given[N_LEADING + 1]), plan[PLAN.order], system.n, local
    )
    rows = np.empty((system.n + 1, local.size))
    members, log_density = new_members(rows[: system.n], system.p, local), rows[system.n]
    observer, health, dt, width = observer_of(request), to.health, system.dt, local.width
    health[0], health[1], health[2] = given[0], NONE, -1
    if system.failure != NONE:
        health[0], health[1], health[2] = 0.0, system.failure, 0.0
    nothing, ancestors = np.empty(0), resampling.ancestors
    k = begin(plan, system, state_given(request), noise, width, members, observer, ancestors)
    if k < 0:
        return STATE
    for j in range(steps.size if health[1] == NONE else 0):
        d, missing = record.observed[j], is_missing(record.observed, j)
        while k < (steps[j] if missing else steps[j] - 1):
            propagate(system, k, t0 + k * dt, process_normals(noise, k), width, members.X)
            k += 1
            emit(observer, FORECAST, j, k, members, nothing, ancestors)
        if missing:
            to.terms[j] = 0.0
            continue
        if k < steps[j]:
            t = t0 + k * dt
            _show_forecast(observer, system, j, k, t, noise, local, members, nothing, ancestors)
            seen = _seen_at(system, d, k + 1, t0 + (k + 1) * dt)
            z = process_normals(noise, k)
            address = np.int64(seen.ctypes.data)
            call_members(plan[PLAN.move_to_observation], system, k, t, z, width, members.X, address)
            k += 1
        else:
            call_members(plan[PLAN.condition], system, k, t0 + k * dt, d, NULL, members.X, NULL)
        increment, n_effective = _weigh(members, log_density, local)
        to.n_effective[j] = n_effective
        health[0] = min(health[0], n_effective)
        if increment == -np.inf:
            health[1] = failure_of_all(system, k, t0 + k * dt, d, members, local)
            health[0], health[2], to.n_effective[j] = 0.0, j, 0.0
            break
        to.terms[j] = increment
        emit(observer, UPDATED, j, k, members, d, ancestors)
        z = resampling_normals(noise, j, k)
        log_w, w = members.log_w, members.w
        if resample_if_few(resampling, n_effective, z, log_w, w, members.X, local):
            emit(observer, RESAMPLED, j, k, members, nothing, ancestors)
    finish(steps.size, k, members, observer, ancestors, to)
    return OK


@dataclass(frozen=True)
class RBPF(ParticleFilter):
    """Rao-Blackwellised particle filter: for systems that switch between regimes.

    A regime is a state of finitely many values, drawn in ``process_dist`` by `pm.Bernoulli`,
    `pm.Categorical`, `pm.DiscreteUniform` or `pm.Binomial`, or several such states; the other
    states are driven by normal noise. A particle is a path of regimes, with the mean and covariance
    that ``inner`` finds for the other states given this path. Where the system is linear given the
    regimes, and their probabilities do not depend on the other states, the estimate of the
    likelihood has the exact likelihood as its mean, for any number of particles, and far less noise
    than that of `BootstrapPF`. Otherwise it has the error of ``inner``, or that of probabilities of
    regimes given a Gaussian state, see `IMM`.

    Parameters
    ----------
    n_particles : int
        Number N of particles, at least 2.
    resample_below : float
        Resample after an observation if the effective number of particles is below this fraction of
        N: 1 resamples at every observation, 0 never.
    resampling : {"systematic", "multinomial", "sorted"}
        Resampling scheme, see `BootstrapPF`.
    inner : EKF, UKF or IPLF
        The filter of the other states given the regimes.

    Raises
    ------
    ModelError
        If ``n_particles`` is not an integer of at least 2, ``resample_below`` is not between 0 and
        1, ``resampling`` is not one of the three names, or ``inner`` is another filter.

    Notes
    -----
    Doucet, de Freitas, Murphy and Russell (2000), "Rao-Blackwellised particle filtering for dynamic
    Bayesian networks", Proceedings of the 16th Conference on Uncertainty in Artificial
    Intelligence, 176-183. On the last step in front of an observation every regime is tried, and
    one is drawn given the observation, as in Chen and Liu (2000), "Mixture Kalman filters", Journal
    of the Royal Statistical Society B 62, 493-508; those of earlier steps are drawn from
    their own distribution. Particles of a `run_filter` are regimes and means.

    Examples
    --------
    >>> import numpy as np
    >>> import pymc as pm
    >>> import pytensor.tensor as pt
    >>> import pymc_statespace_filters as psf
    >>> def noise(x, stay=0.9):
    ...     regime = pm.Bernoulli.dist(pt.switch(x[1] > 0, stay, 1 - stay))
    ...     return [regime, pm.Normal.dist(0, pt.switch(regime > 0, 1.0, 0.2))]
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q: [0.9 * x[0] + q[1], q[0]],
    ...     process_dist=noise,
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.1]],
    ...     initial_dist=lambda: [pm.Normal.dist(0, 1), pm.Bernoulli.dist(0.5)],
    ...     states=["level", "regime"],
    ... )
    >>> estimates = psf.log_likelihood(
    ...     system, psf.RBPF(100), {}, [0.1, 0.3, 2.0], steps=[1, 2, 3], seed=np.arange(20)
    ... )
    >>> estimates.shape
    (20, 3)
    """

    entry: ClassVar[EntryPoint] = likelihood_entry("rbpf", _evaluate, needs=(FILL_NORMALS,))
    _: KW_ONLY
    resample_below: float = 0.5
    inner: EKF | UKF | IPLF = field(default=EKF())

    def __post_init__(self) -> None:
        super().__post_init__()
        check_inner(self.inner)

    def check(self, system: System) -> None:
        """Raise unless the system has regimes, and ``inner`` takes the others given these."""
        check_hybrid("RBPF", system, self.inner)
        check_sortable(self.resampling, self._particles(system).system.n)

    def is_exact_for(self, system: System) -> bool:
        """Whether it is linear given regimes whose probabilities do not depend on other states."""
        hybrid = hybrid_of(system.written)
        return compile_system(hybrid.given).is_linear and not hybrid.deciding

    def linearised(self, system: System) -> System:
        """The system of the other states, which is linearised."""
        return compile_system(hybrid_of(system.written).given)

    def smooth(self, system: System) -> "RBPF":
        """Return this filter with an estimate that changes little when its normals do."""
        return smooth_resampling(self, self._particles(system).system.n)

    def noise_sizes(self, system: System) -> NoiseSizes:
        """Return how many normals the filter takes where: one decides on a regime."""
        return NoiseSizes(padded(self.size()), 1, 1, 0, self.resampling_normals())

    def functions(self) -> Sequence[str]:
        """Return the names of the functions of the particles that the entry calls."""
        return "initialise", "propagate", "log_density"

    def compile_states(self, system: System, moment: str) -> PlannedFunction:
        """Compile "predicted", "filtered" or "smoothed" states."""
        if moment == "smoothed":
            return PlannedFunction(self.smoother(system), *STATES)
        return PlannedFunction(self._observed(system, STATES_OF_MIXTURE, moment), *STATES)

    def compile_run(self, system: System) -> PlannedFunction:
        """Compile one run with all that it computes."""
        return PlannedFunction(self._observed(system, RUN_OF_MIXTURE, "filtered"), *RUN)

    def _observed(self, system: System, run: EntryPoint, moment: str) -> Plan:
        last_event = LAST_EVENTS[moment]
        return self.observed(system, run, observer=SUMMARISE_MIXTURE, last_event=last_event)

    def law_of_state(self, system: System, states: np.ndarray) -> StateLaw:
        """Return the law of the state, from what the filter leaves (m, S) at m points."""
        particles = self._particles(system)
        n_finite, order = particles.hybrid.regimes.shape[1], particles.hybrid.order
        return weighted_columns(states, particles.system.n, n_finite, order)

    def smoother(self, system: System) -> Plan:
        """Plan backward simulation."""
        moves = moves_of_parts(system.written, self.inner.linearization).entry
        return self.observed(system, SMOOTH_MIXTURE, observer=STORE, moves=moves)

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""
        return "backward simulation"

    def plan(
        self, system: System, run: EntryPoint, functions: Sequence[str], **others: int | EntryPoint
    ) -> Plan:
        """Return the plan of a function that reads the settings of this filter."""
        particles, size = self._particles(system), self.size()
        hybrid, order = particles.hybrid, self.ordering()
        if functions:
            names = ("condition", "move_to_observation")
            others |= {name: getattr(particles, name).entry for name in names}
        if order is not None:
            others["order"] = order
        settings = (
            size, *self.noise_sizes(system), *self.settings(), hybrid.regimes.shape[1],
            len(hybrid.drawn), *hybrid.order,
        )  # fmt: skip
        return make_plan(
            particles.system, run, functions, settings, n_members=size,
            state_size=1 + (particles.system.n + 1) * size, **others,
        )  # fmt: skip

    def _particles(self, system: System) -> HybridParticles:
        return hybrid_particles(system.written, self.inner.linearization)
