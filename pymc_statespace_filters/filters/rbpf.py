"""Rao-Blackwellised particle filter: particles carry regimes, each with a Kalman filter.

Particles move as those of any filter, each with its own mean and covariance, up to the last step in
front of an observation, which tries all that may happen. See `regimes.particles` for both.
"""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np

from ..compiler.lowering.compiled_system import compile_system
from ..compiler.native.entry_point import EntryPoint
from ..compiler.native.jit import copy_into, keep_alive, njit_internal
from ..compiler.native.plan import Plan
from ..compiler.numerics.normals import padded
from .ekf import EKF
from .ensemble.backward_simulation import STORE
from .ensemble.callbacks import FORECAST
from .ensemble.evaluation import Members, members_with, show, time_of
from .ensemble.failures import failure_of_all
from .ensemble.kalman_update import mark_finite
from .ensemble.loop import Outcome, advance, failed, member_filter, start
from .ensemble.noise import NoiseSizes, process_normals
from .ensemble.particle_filter import ParticleFilter
from .ensemble.resampling import check_sortable, smooth_resampling
from .ensemble.weights import normalise_weights
from .iplf import IPLF
from .outcomes import NONE, is_missing
from .plan import NULL, PLAN, call_members, propagate
from .protocol import System
from .regimes.backward_simulation import SMOOTH_PARTICLES
from .regimes.checks import check_hybrid, check_inner
from .regimes.hybrid import hybrid_of
from .regimes.moves import moves_of_parts
from .regimes.particles import HybridParticles, hybrid_particles
from .state_law import Layout
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
def _show_forecast(call, j, k, members):
    """Show copies of the particles that move without the observation at the end of the step."""
    copies = members_with(members, members.X.copy(), members.log_w)
    z = process_normals(call.noise, k)
    propagate(call.system, k, time_of(call, k), z, call.local.width, copies.X)
    show(call, FORECAST, j, k + 1, copies, call.nothing)


class Parts(NamedTuple):
    """The particles, and whether they have moved to a row with its observation, (1,)."""

    members: Members
    has_moved: np.ndarray


@njit_internal
def _start(call):
    k, (members,) = start(call)
    return k, Parts(members, np.zeros(1, np.bool_))


@njit_internal
def _advance(call, j, k, last, parts):
    """Move up to the row, by the last step given its observation."""
    record, members = call.record, parts.members
    if is_missing(record.observed, j):
        advance(call, j, k, last, parts)
        return
    advance(call, j, k, last - 1, parts)
    k = last - 1
    if call.observer[0] != 0:
        _show_forecast(call, j, k, members)
    seen = _seen_at(call.system, record.observed[j], k + 1, time_of(call, k + 1))
    z, width, gains = process_normals(call.noise, k), call.local.width, np.int64(seen.ctypes.data)
    move = call.plan[PLAN.move_to_observation]
    call_members(move, call.system, k, time_of(call, k), z, width, members.X, gains)
    keep_alive(seen)
    parts.has_moved[0] = True


@njit_internal
def _observe(call, j, k, parts):
    """Add the log-densities of the observation, which are behind the particles, to the weights."""
    members, t, d = parts.members, time_of(call, k), call.record.observed[j]
    if not parts.has_moved[0]:
        condition = call.plan[PLAN.condition]
        call_members(condition, call.system, k, t, d, NULL, members.X, NULL)
    parts.has_moved[0] = False
    mark_finite(members.X, members.X, members.alive)
    log_w = members.log_w
    for i in range(log_w.size):
        members.alive[i] &= log_w[i] > -np.inf
        log_w[i] = log_w[i] + members.behind[i] if members.alive[i] else -np.inf
    increment, n_effective = normalise_weights(log_w, members.w, call.local)
    if increment == -np.inf:
        return failed(failure_of_all(call.system, k, t, d, members, call.local))
    return Outcome(increment, n_effective, n_effective, NONE)


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

    entry: ClassVar[EntryPoint] = member_filter("rbpf", _observe, start=_start, advance=_advance)
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

    def system_of_parts(self, system: System) -> System:
        """Return the system of the particles."""
        return self._particles(system).system

    def layout(self, system: System) -> Layout:
        """Return what a particle holds: regimes, then mean and covariance of the other states."""
        particles = self._particles(system)
        hybrid = particles.hybrid
        return Layout(particles.system.n, hybrid.regimes.shape[1], hybrid.order)

    def settings(self, system: System) -> tuple[float, ...]:
        """Return how many draws of the finite variables a step has."""
        return (len(self._particles(system).hybrid.drawn),)

    def smoother(self, system: System) -> Plan:
        """Plan backward simulation."""
        moves = moves_of_parts(system.written, self.inner.linearization).entry
        return self.observed(system, SMOOTH_PARTICLES, observer=STORE, moves=moves)

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""
        return "backward simulation"

    def plan(
        self, system: System, run: EntryPoint, functions: Sequence[str], **others: int | EntryPoint
    ) -> Plan:
        """Return the plan of a function that reads the settings of this filter."""
        if functions:
            particles, names = self._particles(system), ("condition", "move_to_observation")
            others |= {name: getattr(particles, name).entry for name in names}
        return super().plan(system, run, functions, **others)

    def _particles(self, system: System) -> HybridParticles:
        return hybrid_particles(system.written, self.inner.linearization)
