"""Bootstrap particle filter (thesis, section 4.4, Eqs. 4.27-4.28, 4.43-4.44): the unbiased one."""

from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np

from pymc_statespace_filters.compiler.lowering.ensemble import Machine
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint
from pymc_statespace_filters.compiler.native.jit import inline_always
from pymc_statespace_filters.filters.ensemble.base import EnsembleFilter
from pymc_statespace_filters.filters.ensemble.kalman_update import mark_finite
from pymc_statespace_filters.filters.ensemble.loop import filter_entry
from pymc_statespace_filters.filters.ensemble.particle_filter import (
    particle_smoother,
    particle_smoothing_method,
)
from pymc_statespace_filters.filters.ensemble.reductions import exchange, sum_values, total
from pymc_statespace_filters.filters.ensemble.resampling import (
    SCHEMES,
    check_sortable,
    n_normals,
    smooth_resampling,
)
from pymc_statespace_filters.filters.ensemble.system_table import log_density
from pymc_statespace_filters.filters.ensemble.weights import normalise_local, total_weight, weigh
from pymc_statespace_filters.filters.outcomes import NO_FINITE_MEMBER, NONE, ZERO_WEIGHTS
from pymc_statespace_filters.filters.settings import check_choice, check_count, check_fraction
from pymc_statespace_filters.system.model import StateSpaceModel


@inline_always
def _workspace(system, local, settings):
    return ()


@inline_always
def _update(system, j, k, t, d, noise, members, local, work):
    X, _, _, w, log_w, log_p, alive = members

    # Weights (Eq. 4.28); log_w holds the normalised weights of the previous observation
    mark_finite(X, X, alive)
    log_density(system, k, t, d, X, log_p)
    for i in range(alive.size):
        log_w[i] = log_w[i] + log_p[i] if alive[i] else -np.inf
    weigh(log_w, w, local, 0)
    sum_values(alive, local, 3)
    exchange(local, 4)
    if total(local, 3) == 0.0:
        return -np.inf, 0.0, NO_FINITE_MEMBER
    increment, n_effective = total_weight(local, 0)  # Eq. 4.43
    if increment == -np.inf:
        return -np.inf, 0.0, ZERO_WEIGHTS
    normalise_local(increment, log_w, w, local, 0)
    return increment, n_effective, NONE


@dataclass(frozen=True)
class BootstrapPF(EnsembleFilter):
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
        Scheme; "multinomial" is the thesis's, "systematic" has less noise. "sorted" is systematic
        along particles in order, one state by its size, up to eight along a Hilbert curve: the
        estimate then moves little when its normals do.

    Raises
    ------
    ModelError
        If ``n_particles`` is not an integer of at least 2, ``resample_below`` is not between 0 and
        1, or ``resampling`` is not one of the three names.

    Notes
    -----
    A particle with a non-finite state has weight zero.

    Examples
    --------
    >>> BootstrapPF(1000, resampling="multinomial").resample_below
    0.333
    """

    n_particles: int
    _: KW_ONLY
    resample_below: float = 1 / 3
    resampling: str = "systematic"

    unbiased: ClassVar[bool] = True
    entry: ClassVar[EntryPoint] = filter_entry(
        "bootstrap_pf", _workspace, _update, n_settings=2, resamples=True
    )

    def __post_init__(self) -> None:
        object.__setattr__(self, "n_particles", check_count("n_particles", self.n_particles))
        fraction = check_fraction("resample_below", self.resample_below)
        object.__setattr__(self, "resample_below", fraction)
        check_choice("resampling", self.resampling, SCHEMES)

    def size(self) -> int:
        """Return the number of particles."""
        return self.n_particles

    def settings(self) -> tuple[float, ...]:
        """Return the threshold of resampling and the number of its scheme."""
        return self.resample_below, SCHEMES.index(self.resampling)

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

    def smoother(self, system: StateSpaceModel, machine: Machine) -> Any:
        """Bind the smoother of this filter to one system."""
        return particle_smoother(self, system, machine, nudges=False)

    def smoothing_method(self, system: StateSpaceModel) -> str:
        """Name the method of the smoothed states."""
        return particle_smoothing_method(system)
