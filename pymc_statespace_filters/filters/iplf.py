"""The iterated posterior linearisation filter: observations by a regression over their posterior.

A. F. Garcia-Fernandez, L. Svensson, M. R. Morelande and S. Sarkka, "Posterior linearization filter:
principles and implementation using sigma points", IEEE Trans. Signal Processing 63 (2015); for
observations with a distribution, by its conditional moments: F. Tronarp, A. F. Garcia-Fernandez and
S. Sarkka, "Iterative filtering and smoothing in nonlinear and non-Gaussian systems using
conditional moments", IEEE Signal Processing Letters 25 (2018).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytensor.tensor as pt
from pytensor.gradient import disconnected_grad
from pytensor.tensor.linalg import cholesky, solve_triangular
from pytensor.tensor.variable import TensorVariable

from ..compiler.lowering.observation import (
    conditional_moments,
    observation_log_density,
    unknown_moments,
)
from ..errors import ModelError
from ..system.checks import check_count
from ..system.distributions import SCALAR_LAWS, law_name
from ..system.model import StateSpaceModel
from .gaussian.base import GaussianFilterBase
from .gaussian.linearization import GaussianState, Seen, Symbols, seen
from .gaussian.sigma_points import SigmaPoints, at_points
from .protocol import System, check_sensor_has_noise

_MOST_ITERATIONS = 1000


@dataclass(frozen=True, kw_only=True)
class IPLF(GaussianFilterBase):
    """Iterated posterior linearisation filter: takes counts, and works with NUTS.

    Steps are those of `UKF`. The linearisation of an observation is over the state given that
    observation, where it matters, instead of over the forecast, and is found by iterating. The
    observation needs only a mean and a variance given the state, so that ``observation_dist`` may
    be Poisson, binomial, negative binomial and so on. The likelihood of an observation is the
    integral of its exact density, by sigma points of the posterior.

    Parameters
    ----------
    n_iterations : int
        How often the observation is linearised, at least 1. Where a sensor is precise beside the
        forecast and its equation bends, fewer than the default do not reach the posterior.

    Raises
    ------
    ModelError
        If ``n_iterations`` is not an integer from 1 to 1000.

    Notes
    -----
    The iteration has a fixed length, so that the likelihood is smooth and its gradient exact; it is
    not checked for convergence. With ``n_iterations=1`` and Gaussian noise the state is that of
    `UKF`. The posterior of the state stays Gaussian with a covariance from the variances of the
    observation: outliers of a Student t pull the state as they would pull it with Gaussian noise.
    A variance that is infinite, of a Student t with ``nu <= 2``, gives minus infinity.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.IPLF()
    IPLF(n_iterations=5)
    """

    n_iterations: int = 5

    def __post_init__(self) -> None:
        check_count("n_iterations", self.n_iterations, 1, _MOST_ITERATIONS)

    @property
    def linearization(self) -> "PosteriorLinearization":
        """Regressions over the state before each step and after each observation."""
        return PosteriorLinearization(n_iterations=self.n_iterations)

    def check(self, system: System) -> None:
        """Raise if the moments of the observation are unknown or a state is carried."""
        self._check_not_carried(system)
        self._check_no_jumping_parameters(system)
        check_sensor_has_noise(type(self).__name__, system)
        if system.has_gaussian_sensor:
            return
        if system.model.is_censored:
            raise ModelError(
                "IPLF takes censored values of an observation function with Gaussian noise, got "
                "censored values of observation_dist"
            )
        if system.model.equations.observation_draw is None:
            raise ModelError(
                "IPLF needs the mean and variance of an observation, which observation_logp does "
                "not give and observation_dist does"
            )
        unknown = unknown_moments(system.model)
        if unknown:
            names = ", ".join(sorted(map(law_name, SCALAR_LAWS)))
            raise ModelError(
                f"IPLF needs the mean and variance of an observation, which it knows for {names}; "
                f"got {', '.join(unknown)}"
            )


class _Posterior(NamedTuple):
    """xi ~ N(mean, T T') with T = I - jac' left, its inverse I + half' jac, and log det T."""

    mean: TensorVariable
    jac: TensorVariable
    left: TensorVariable
    half: TensorVariable
    log_det: TensorVariable

    def of_state(self, prior: GaussianState) -> tuple[TensorVariable, TensorVariable]:
        """Mean and a root of the covariance of x = prior.mean + prior.root xi."""
        root = prior.root - (prior.root @ self.jac.T) @ self.left
        return prior.mean + prior.root @ self.mean, root

    def by_prior(self, jac: TensorVariable) -> TensorVariable:
        """The derivative by xi for that by T^-1 xi."""
        return jac + (jac @ self.half.T) @ self.jac


@dataclass(frozen=True)
class PosteriorLinearization(SigmaPoints):
    """Statistical linear regression of an observation over the state given that observation."""

    n_iterations: int = 5

    def observation(self, system: StateSpaceModel, values: Symbols, state: GaussianState) -> Seen:
        """The observation ``values["d"]``, linearised over its posterior."""
        n = system.n
        moments = at_points(conditional_moments, system, values)
        nothing = pt.zeros((system.p, n))
        posterior = _Posterior(pt.zeros((n,)), nothing, nothing, nothing, pt.zeros(()))
        for _ in range(self.n_iterations):
            centre, root = posterior.of_state(state)
            line = self.regress(moments, centre, root)
            jac = posterior.by_prior(line.jac)
            line = line._replace(mean=line.mean - jac @ posterior.mean, jac=jac)
            observation = seen(system, values, state, line)
            if system.equations.observation_draw is not None:
                observation = _without_certain(observation)
            posterior = _posterior(observation)
        term = self._log_density(system, values, state, posterior)
        return observation._replace(term=term)

    def _log_density(
        self, system: StateSpaceModel, values: Symbols, state: GaussianState, posterior: _Posterior
    ) -> TensorVariable:
        """log p(d), the integral of p(d | x) N(xi; 0, I), by the sigma points of the posterior.

        The sum is that of importance weights, and exact where p(d | x) is Gaussian in x.
        """
        n, square = system.n, self.squared_distance(system.n)
        xi = self.points(posterior.mean, pt.eye(n) - posterior.jac.T @ posterior.left)
        (log_p,) = at_points(_log_p, system, values, ("u", "t", "d"))(
            self.points(*posterior.of_state(state))
        )
        weights, squares = np.full(2 * n + 1, 0.5 / square), np.full(2 * n + 1, square)
        weights[0], squares[0] = 1.0 - n / square, 0.0
        first = 0 if weights[0] > 0.0 else 1
        terms = log_p - 0.5 * pt.sum(xi**2, axis=1)
        terms = terms[first:] + (np.log(weights[first:]) + 0.5 * squares[first:])
        largest = disconnected_grad(pt.max(terms))
        unit = pt.switch(pt.eq(largest, -np.inf), 0.0, largest)
        return unit + pt.log(pt.sum(pt.exp(terms - unit))) + posterior.log_det


def _without_certain(observation: Seen) -> Seen:
    """The observation with a unit variance where it has none, as a count of mean zero has.

    Such a number is the same at all states, and says nothing of them.
    """
    variances = pt.diagonal(observation.noise_cov)
    is_certain = pt.eq(variances, 0.0) & pt.all(pt.eq(observation.jac, 0.0), axis=1)
    unit = pt.diag(pt.cast(is_certain, "float64"))
    return observation._replace(noise_cov=observation.noise_cov + unit)


def _posterior(observation: Seen) -> _Posterior:
    """The law of xi given the observation, N(0, I) before it.

    With J = noise_cov^-1/2 jac and the factor C C' = I + J J', a root of the covariance is
    T = I - J' C'^-1 (C + I)^-1 J, and its inverse is I + J' (C' + I)^-1 J (A. Andrews, "A square
    root formulation of the Kalman covariance equations", AIAA Journal 6, 1968).
    """
    one = pt.eye(observation.jac.type.shape[0])
    noise = cholesky(observation.noise_cov, lower=True)
    jac = solve_triangular(noise, observation.jac, lower=True, b_ndim=2)
    residual = solve_triangular(noise, observation.residual, lower=True, b_ndim=1)
    factor = cholesky(one + jac @ jac.T, lower=True)
    half = solve_triangular(factor + one, jac, lower=True, b_ndim=2)
    white = solve_triangular(factor, residual, lower=True, b_ndim=1)
    return _Posterior(
        jac.T @ solve_triangular(factor.T, white, lower=False, b_ndim=1),
        jac,
        solve_triangular(factor.T, half, lower=False, b_ndim=2),
        half,
        -pt.sum(pt.log(pt.diagonal(factor))),
    )


def _log_p(system: StateSpaceModel, values: Symbols) -> list[TensorVariable]:
    """log p(d | x)."""
    return [observation_log_density(system, values)]
