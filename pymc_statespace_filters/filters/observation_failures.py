"""Where an observation equation is defined; asked only after an update has failed."""

import numpy as np

from ..compiler.native.jit import njit_internal
from .outcomes import OBSERVATION_UNDEFINED, ZERO_DENSITY
from .plan import log_density


@njit_internal
def mark_defined(system, k, t, d, X, log_p, defined):
    """Clear ``defined`` at the states X (n, N) at which no observation has a density.

    The log-density is then NaN. An infinite mean has density zero, but then an observation of zero
    has too.
    """
    log_density(system, k, t, d, X, log_p)
    for i in range(log_p.size):
        defined[i] &= not np.isnan(log_p[i])
    if system.has_gaussian_observation:
        log_density(system, k, t, 0.0 * d, X, log_p)
        for i in range(log_p.size):
            defined[i] &= np.isfinite(log_p[i])


@njit_internal
def observation_failure(system, k, t, d, X):
    """Why an observation has no density at any of the states X (n, N)."""
    defined = np.ones(X.shape[1], np.bool_)
    mark_defined(system, k, t, d, X, np.empty(X.shape[1]), defined)
    return np.int64(ZERO_DENSITY if defined.any() else OBSERVATION_UNDEFINED)
