"""Bootstrap particle filter (thesis, section 4.4, Eqs. 4.27-4.28, 4.43-4.44): the unbiased one."""

import math
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

import numpy as np

from pymc_statespace_filters.filters._base import EnsembleFilter
from pymc_statespace_filters.filters._checks import check_choice, check_count, check_fraction
from pymc_statespace_filters.filters._compile import pasted
from pymc_statespace_filters.filters._ensemble import mark_finite
from pymc_statespace_filters.filters._failures import NO_FINITE_MEMBER, NONE, ZERO_WEIGHTS
from pymc_statespace_filters.filters._loop import filter_loop
from pymc_statespace_filters.filters._resampling import POINTS, choose_ancestors, copy_ancestors
from pymc_statespace_filters.filters._weights import effective_number, normalise


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
    resampling : {"systematic", "multinomial"}
        Scheme; "multinomial" is the thesis's, "systematic" has less noise.

    Raises
    ------
    ModelError
        If ``n_particles`` is not an integer of at least 2, ``resample_below`` is not between 0 and
        1, or ``resampling`` is not one of the two names.

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

    def __post_init__(self) -> None:
        object.__setattr__(self, "n_particles", check_count("n_particles", self.n_particles))
        fraction = check_fraction("resample_below", self.resample_below)
        object.__setattr__(self, "resample_below", fraction)
        check_choice("resampling", self.resampling, POINTS)

    def kernel(self, machine):
        """Compile the filter for one system; see ``_loop.filter_loop`` for what is returned."""
        N, n = self.n_particles, machine.n
        log_density = machine.log_density
        draw_points = POINTS[self.resampling]
        always, threshold = self.resample_below == 1.0, self.resample_below * N
        log_N = math.log(N)

        @pasted
        def workspace():
            w, log_w, log_p = np.empty(N), np.empty(N), np.empty(N)
            log_w[:] = -log_N
            alive, points, ancestors = np.empty(N, np.bool_), np.empty(N + 1), np.empty(N, np.int64)
            return w, log_w, log_p, alive, points, ancestors, np.empty((n, N))

        @pasted
        def update(c, inputs, k, t, d, seed, X, work):
            w, log_w, log_p, alive, points, ancestors, buffer = work

            # Weights (Eq. 4.28); log_w holds the normalised weights of the previous observation
            if mark_finite(X, X, alive) == 0:
                return -np.inf, 0.0, NO_FINITE_MEMBER
            log_density(c, inputs, k, t, d, X, log_p)
            for i in range(N):
                log_w[i] = log_w[i] + log_p[i] if alive[i] else -np.inf
            increment = normalise(log_w, w)
            if increment == -np.inf:
                return -np.inf, 0.0, ZERO_WEIGHTS
            n_effective = effective_number(w)  # Eq. 4.43

            # Resampling
            if always or n_effective < threshold:
                draw_points(seed, k, points)
                choose_ancestors(w, points, ancestors)
                copy_ancestors(ancestors, X, buffer)
                log_w[:] = -log_N
            return increment, n_effective, NONE

        return filter_loop(machine, N, workspace, update)
