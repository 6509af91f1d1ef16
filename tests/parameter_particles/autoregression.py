"""A linear record, and its exact evidence after each row, by Kalman's filter and quadrature."""

from functools import cache
from typing import NamedTuple

import numpy as np
import pymc as pm
from scipy.special import logsumexp
from scipy.stats import norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.systems import FREE

STEPS = np.arange(1, 25)
# Simulated with a = .8, and a row missing.
DATA = np.array([
    1.3317, 0.2155, -0.2731, 0.9242, 0.8474, 0.6878, 0.463, np.nan, 0.1482, 0.3095, 0.8824, -0.9365,
    -1.2281, -1.1547, 0.6702, -2.0409, 1.081, 0.7985, -0.6001, -1.3336, -1.1068, -1.8589, -1.3109,
    -1.1553,
])[:, None]  # fmt: skip


class Exact(NamedTuple):
    """Log-evidences of the first rows (J,), and the posterior mean of `a` given all."""

    path: np.ndarray
    mean: float


@cache
def exact_transforms():
    """The probability (J,) of less than what was observed, given the rows before it."""
    a, (observed,) = np.linspace(-10, 10, 801), DATA.T
    mean, variance, log_weights, found = np.zeros(a.size), 1.0, norm(0, 2).logpdf(a), []
    for y in observed:
        mean, variance = a * mean, a**2 * variance + 1
        seen = norm(mean, np.sqrt(variance + 0.5))
        found.append(np.exp(log_weights - logsumexp(log_weights)) @ seen.cdf(y))
        if np.isfinite(y):
            log_weights = log_weights + seen.logpdf(y)
            gain = variance / (variance + 0.5)
            mean, variance = mean + gain * (y - mean), (1 - gain) * variance
    return np.array(found)


def model(filter, n_rows=None, **changes):
    """The model of the first rows."""
    with pm.Model() as built:
        pm.Normal("a", 0, 2)
        settings = {"steps": STEPS[:n_rows], "observed": DATA[:n_rows]} | changes
        psf.StateSpace("d", FREE, filter, **settings)
    return built


@cache
def exact():
    """Trapezoids on a grid that holds the posterior given any number of rows, but the first few."""
    a, width = np.linspace(-10, 10, 801, retstep=True)
    noise = {"steps": STEPS, "observed": DATA}
    terms = [kalman_log_likelihood([[v]], [[1]], [[1]], [[0.5]], [0], [[1]], **noise) for v in a]
    log_joint = np.cumsum(terms, axis=1) + norm(0, 2).logpdf(a)[:, None]
    path = logsumexp(log_joint, axis=0) + np.log(width)
    weights = np.exp(log_joint[:, -1] - path[-1]) * width
    return Exact(path, float(weights @ a))
