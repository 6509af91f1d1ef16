r"""Densities of strengths of drift given the other parameters, as Chen's estimator averages them.

A strength s is fitted by :math:`s^2 \sim \text{Gamma}` with a mean that is log-linear in the other
parameters: the density of s is finite at zero, where that of a posterior is, and falls like a
normal one, as the posterior under a half-normal prior at least does. Whatever is fitted is a proper
density, so that it decides the error of the estimate and not its mean.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import digamma, gammainc, gammaln

LEAST_SHAPE, LARGEST_SHAPE = 0.5, 1e4  # at the least the density is the half-normal
N_STEPS, MIN_STEP = 50, 1e-6  # of the log of the mean
CLIPPED = 3.0  # standard deviations, at which a regressor ends
RIDGE = 1.0  # pseudo-observations against each regressor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ConditionalStrength:
    """A density of s >= 0 given regressors: s squared is Gamma with a log-linear mean.

    ``largest`` is the end of the support of s, at which the density is truncated.
    """

    centre: Array  # (r,)
    scale: Array  # (r,)
    coefficients: Array  # (1 + r,)
    shape: float
    largest: float = np.inf

    def log_density(self, s: Array, regressors: Array) -> Array:
        """At strengths s (n,) and regressors (n, r), shape (n,)."""
        rate = self.shape / self.mean_square(regressors)
        inside = np.log(gammainc(self.shape, rate * self.largest**2))
        with np.errstate(divide="ignore"):
            log_s = np.log(s)
        power = (2 * self.shape - 1) * log_s if self.shape != LEAST_SHAPE else 0.0
        return (
            np.log(2) + power + self.shape * np.log(rate) - rate * s**2
            - gammaln(self.shape) - inside
        )  # fmt: skip

    def mean_square(self, regressors: Array) -> Array:
        """The mean of s squared at regressors (n, r), without truncation."""
        return np.asarray(np.exp(_design(regressors, self.centre, self.scale) @ self.coefficients))


def fit_conditional(s: Array, regressors: Array, largest: float = np.inf) -> ConditionalStrength:
    """Fit to draws s (n,) with regressors (n, r), by the quasi-likelihood of Gamma variables."""
    centre, scale = regressors.mean(axis=0), regressors.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    design = _design(regressors, centre, scale)
    square = s**2 + np.finfo(float).tiny
    coefficients = np.zeros(design.shape[1])
    coefficients[0] = np.log(square.mean())
    penalty = RIDGE * np.diag(np.arange(len(coefficients)) > 0).astype(float)
    inverse = np.linalg.inv(design.T @ design + penalty)
    for _ in range(N_STEPS):
        excess = square * np.exp(-design @ coefficients) - 1
        step = np.clip(inverse @ (design.T @ excess - penalty @ coefficients), -1, 1)
        coefficients = coefficients + step
        if np.abs(step).max() < MIN_STEP:
            break
    ratio = square * np.exp(-design @ coefficients)
    return ConditionalStrength(centre, scale, coefficients, _gamma_shape(ratio), largest)


def _design(regressors: Array, centre: Array, scale: Array) -> Array:
    # A regressor with a long tail, such as the log of another strength, must not extrapolate.
    clipped = np.clip((regressors - centre) / scale, -CLIPPED, CLIPPED)
    return np.column_stack([np.ones(len(clipped)), clipped])


def _gamma_shape(ratio: Array) -> float:
    """The maximum-likelihood shape of Gamma variables (n,), within limits."""
    gap = np.log(ratio.mean()) - np.log(ratio).mean()

    def excess(shape: float) -> float:
        return float(np.log(shape) - digamma(shape) - gap)

    if excess(LEAST_SHAPE) <= 0:
        return LEAST_SHAPE
    return LARGEST_SHAPE if excess(LARGEST_SHAPE) >= 0 else brentq(excess, 0.5, LARGEST_SHAPE)
