"""Temperatures at which a population passes from one distribution to another."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

Array = NDArray[np.float64]


def next_temperature(
    temperature: float,
    log_likelihood: Array,
    ess_fraction: float,
    log_weights: Array | float = 0.0,
) -> float:
    """The inverse temperature at which the effective sample size falls to a fraction; at most one.

    The fraction refers to points of positive likelihood: all others are lost at the first step,
    however small. Where the weights that the points have are worth less than the fraction, it is
    the present temperature. Source: Jasra, Stephens, Doucet and Tsagaris 2011, Scand. J. Stat. 38,
    1-22.
    """
    is_alive = np.isfinite(log_likelihood)
    alive = log_likelihood[is_alive]
    before = np.broadcast_to(log_weights, log_likelihood.shape)[is_alive]

    def surplus(step: float) -> float:
        log_weights = before + step * alive
        weights = np.exp(log_weights - log_weights.max())
        return float(weights.sum() ** 2 / (weights @ weights) / len(alive)) - ess_fraction

    if surplus(1 - temperature) >= 0:
        return 1.0
    if surplus(0.0) <= 0:
        return temperature
    # Under a wide prior the step may be smaller than any absolute tolerance, hundreds of halvings.
    found = brentq(surplus, 0.0, 1 - temperature, xtol=1e-300, rtol=1e-9, maxiter=2000)
    return temperature + found
