"""The mixture of Student-t distributions that importance sampling draws from.

The number of components minimises the variance of the weights of held-out draws.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from ...smc.temperature import next_temperature
from ...statistics.importance import normalised, systematic
from ...statistics.student_mixture import (
    StudentMixture,
    fit_mixture,
    mixture_of,
    place_components,
)
from ..posterior import Posterior
from .whitening import moments

MOST_COMPONENTS = 10
MIN_GAIN = 0.02  # in the log of the weights' second moment, to accept a further component
PATIENCE = 2  # further numbers of components tried after the best
MOST_FITTED = 4000  # draws used for the fit
ESS_FRACTION = 0.2  # of a cloud, left by the power of its weights
N_FLATTENED, N_COMPONENTS = 1000, 10  # of the fit to a flattened copy

Array = NDArray[np.float64]


def choose_mixture(posterior: Posterior, rng: np.random.Generator) -> StudentMixture:
    """Fit the mixture of the largest predicted effective sample size to the draws.

    Components are added to a fit of one half of the draws (`Posterior.halves_for_fit`) as long as
    this lowers the second moment of the weights w = p / q on the other half: E_q[w^2] = E_p[w].
    Raises `ModelError` if the draws do not vary in every direction.
    """
    mean, chol = coordinates = moments(posterior.draws)
    halves = [half.thinned(MOST_FITTED // 2) for half in posterior.halves_for_fit()]
    first, second = (coordinates.whitened(half.draws.reshape(-1, len(mean))) for half in halves)
    best, n_best, least = place_components(first, 1, rng), 0, np.inf
    for n_components in range(1, MOST_COMPONENTS + 1):
        q = fit_mixture(first, place_components(first, n_components, rng))
        moment = logsumexp(halves[1].log_density.ravel() - q.log_density(second))
        if moment < least - MIN_GAIN:
            best, n_best, least = q, n_components, moment
        elif n_components == n_best + PATIENCE:
            break
    # Restart EM from the best fit, so that it converges to the same mode.
    final = fit_mixture(np.concatenate([first, second]), best)
    return final.with_defensive_component().affine(mean, chol)


def flattened(x: Array, log_ratio: Array, rng: np.random.Generator) -> Array:
    """Points of x (m, k), drawn by a power of a ratio of densities, of which one is not zero.

    The power is the largest that leaves a fifth of the points.
    """
    power = next_temperature(0.0, log_ratio, ESS_FRACTION)
    return x[systematic(normalised(power * log_ratio), N_FLATTENED, rng)]


def flattened_copy(
    x: Array, log_ratio: Array, rng: np.random.Generator, n_components: int = N_COMPONENTS
) -> list[StudentMixture]:
    """The fit to `flattened` points, if there is one."""
    if not np.isfinite(log_ratio).any():
        return []
    copy = mixture_of(flattened(x, log_ratio, rng), n_components, rng)
    return [] if copy is None else [copy]
