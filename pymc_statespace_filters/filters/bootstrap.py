"""Bootstrap particle filter (thesis, section 4.4, Eqs. 4.27-4.28, 4.43-4.44): the unbiased one."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..compiler.native.entry_point import EntryPoint
from ..compiler.native.jit import inline_always
from .ensemble.evaluation import time_of
from .ensemble.failures import failure_of_all
from .ensemble.kalman_update import mark_finite
from .ensemble.loop import Outcome, failed, member_filter
from .ensemble.particle_filter import ParticleFilter
from .ensemble.weights import normalise_weights
from .outcomes import NONE
from .plan import log_density


@inline_always
def observe(call, j, k, parts):
    """Weight the particles by the density of the observation."""
    members, t, d = parts.members, time_of(call, k), call.record.observed[j]
    X, w, log_w, alive = members.X, members.w, members.log_w, members.alive

    # Weights (Eq. 4.28); log_w holds the normalised weights of the previous observation
    mark_finite(X, X, alive)
    log_density(call.system, k, t, d, X, members.log_p)
    for i in range(alive.size):
        alive[i] &= log_w[i] > -np.inf
        log_w[i] = log_w[i] + members.log_p[i] if alive[i] else -np.inf

    # Increment of the log-likelihood and effective number (Eq. 4.43)
    increment, n_effective = normalise_weights(log_w, w, call.local)
    if increment == -np.inf:
        return failed(failure_of_all(call.system, k, t, d, members, call.local))
    return Outcome(increment, n_effective, n_effective, NONE)


@dataclass(frozen=True)
class BootstrapPF(ParticleFilter):
    """Bootstrap particle filter: particles move under the model, observations weight them.

    Its estimate of the likelihood (not of the log-likelihood) has the exact likelihood of the
    discretised system as its mean, for any number of particles.

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

    Raises
    ------
    ModelError
        If ``n_particles`` is not an integer of at least 2, ``resample_below`` is not between 0 and
        1, or ``resampling`` is not one of the three names.

    Notes
    -----
    A particle with a non-finite state has weight zero.

    Resampled particles are copies. If a state has an uncertain start and no noise reaches it, they
    stay equal there, so the different ones become fewer with every resampling: `GuidedPF` draws the
    start given the data, and `EKF` is exact if the system is linear.

    Examples
    --------
    >>> BootstrapPF(1000, resampling="multinomial").resample_below
    0.333
    """

    unbiased: ClassVar[bool] = True
    counts_copies: ClassVar[bool] = True
    entry: ClassVar[EntryPoint] = member_filter("bootstrap_pf", observe)
