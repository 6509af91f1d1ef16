"""The mixture of Student-t distributions that importance sampling draws from.

The number of components minimises the variance of the weights of held-out draws.
"""

import numpy as np
from scipy.special import logsumexp

from ...student_mixture import StudentMixture, fit_mixture, place_components
from ..posterior import Posterior
from .whitening import moments

MOST_COMPONENTS = 10
MIN_GAIN = 0.02  # in the log of the weights' second moment, to accept a further component
PATIENCE = 2  # further numbers of components tried after the best
MOST_FITTED = 4000  # draws used for the fit


def choose_mixture(posterior: Posterior, rng: np.random.Generator) -> StudentMixture:
    """Fit the mixture of the largest predicted effective sample size to the draws.

    Components are added to a fit of the first half of every chain as long as this lowers the second
    moment of the weights w = p / q on the second half: E_q[w^2] = E_p[w].

    Raises
    ------
    ModelError
        If the draws do not vary in every direction.
    """
    mean, chol = coordinates = moments(posterior.draws)
    halves = [half.thinned(MOST_FITTED // 2) for half in posterior.halves()]
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
