"""Temperatures at which a population passes from the prior to the posterior."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import logsumexp

Array = NDArray[np.float64]


def next_temperature(temperature: float, log_likelihood: Array, ess_fraction: float) -> float:
    """The inverse temperature at which the effective sample size falls to a fraction; at most one.

    The fraction refers to points of positive likelihood: all others are lost at the first step,
    however small. Source: Jasra, Stephens, Doucet and Tsagaris 2011, Scand. J. Stat. 38, 1-22.
    """
    alive = log_likelihood[np.isfinite(log_likelihood)]

    def surplus(step: float) -> float:
        log_effective = 2 * logsumexp(step * alive) - logsumexp(2 * step * alive)
        return math.exp(log_effective) / len(alive) - ess_fraction

    if surplus(1 - temperature) >= 0:
        return 1.0
    # Under a wide prior the step may be smaller than any absolute tolerance, hundreds of halvings.
    found = brentq(surplus, 0.0, 1 - temperature, xtol=1e-300, rtol=1e-9, maxiter=2000)
    return temperature + found
