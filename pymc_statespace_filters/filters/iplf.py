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

from pymc_statespace_filters.compiler.lowering.conditional_moments import (
    MOMENTS,
    conditional_moments,
    unknown_moments,
)
from pymc_statespace_filters.compiler.lowering.gaussian import observation_log_density
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.gaussian.base import GaussianFilterBase
from pymc_statespace_filters.filters.gaussian.linearization import (
    GaussianState,
    Seen,
    Symbols,
    seen,
)
from pymc_statespace_filters.filters.gaussian.sigma_points import (
    SigmaPoints,
    at_points,
)
from pymc_statespace_filters.filters.protocol import System
from pymc_statespace_filters.system.checks import check_count
from pymc_statespace_filters.system.model import StateSpaceModel


@dataclass(frozen=True, kw_only=True)
class IPLF(GaussianFilterBase):
    """Iterated posterior linearisation filter."""

    n_iterations: int = 5

    def __post_init__(self) -> None:
        check_count("n_iterations", self.n_iterations, 1)

    @property
    def linearization(self) -> "PosteriorLinearization":
        """Regressions over the state before each step and after each observation."""
        return PosteriorLinearization(n_iterations=self.n_iterations)

    def check(self, system: System) -> None:
        """Raise if the moments of the observation are unknown or a state is carried."""
        self._check_not_carried(system)
        if system.gaussian_observation:
            return
        if system.model.equations.observation_draw is None:
            raise ModelError(
                "IPLF needs the mean and variance of an observation, which observation_logp does "
                "not give; use observation_dist, or BootstrapPF, PFEnKF or, for one state, "
                "GridFilter"
            )
        unknown = unknown_moments(system.model)
        if unknown:
            names = ", ".join(sorted(kind.__name__.removesuffix("RV") for kind in MOMENTS))
            raise ModelError(
                f"IPLF needs the mean and variance of an observation, which it knows for {names}; "
                f"got {', '.join(unknown)}"
            )


class _Posterior(NamedTuple):
    """xi ~ N(mean, precision^-1), with the lower factor of the precision."""

    mean: TensorVariable
    factor: TensorVariable

    def root(self) -> TensorVariable:
        """A root of the covariance."""
        n = self.mean.type.shape[0]
        return solve_triangular(self.factor.T, pt.eye(n), lower=False, b_ndim=2)


@dataclass(frozen=True)
class PosteriorLinearization(SigmaPoints):
    """Statistical linear regression of an observation over the state given that observation.

    In the coordinates xi, in which the state before the observation is N(0, I), the posterior has
    the precision I + jac' noise_cov^-1 jac, which is never singular.
    """

    n_iterations: int = 5

    def observation(self, system: StateSpaceModel, values: Symbols, state: GaussianState) -> Seen:
        """The observation ``values["d"]``, linearised over its posterior."""
        datum, n = _datum(system, values["d"]), system.n
        moments = at_points(conditional_moments, system, values)

        def moments_at(xi: TensorVariable) -> tuple[TensorVariable, TensorVariable]:
            return moments(state.mean + state.root @ xi)

        posterior = _Posterior(pt.zeros((n,)), pt.eye(n))
        for _ in range(self.n_iterations):
            line = self.regress(moments_at, posterior.mean, posterior.root())
            jac = line.jac @ posterior.factor.T
            observation = seen(datum, line._replace(mean=line.mean - jac @ posterior.mean, jac=jac))
            posterior = _posterior(observation)
        term = self._log_density(system, {**values, "d": datum}, state, posterior)
        return observation._replace(term=term)

    def _log_density(
        self, system: StateSpaceModel, values: Symbols, state: GaussianState, posterior: _Posterior
    ) -> TensorVariable:
        """log p(d), the integral of p(d | x) N(xi; 0, I), by the sigma points of the posterior.

        The sum is that of importance weights, and exact where p(d | x) is Gaussian in x.
        """
        n = system.n
        square = self.squared_distance(n)
        offsets = np.sqrt(square) * posterior.root()
        points = [posterior.mean + sign * offsets[:, i] for i in range(n) for sign in (1.0, -1.0)]
        weights = [1.0 / (2.0 * square)] * len(points)
        if n < square:
            points, weights = [posterior.mean, *points], [1.0 - n / square, *weights]
        log_terms = []
        for xi, weight in zip(points, weights, strict=True):
            x = state.mean + state.root @ xi
            log_p = observation_log_density(system, {**values, "x": x})
            q = 0.0 if xi is posterior.mean else -0.5 * square
            log_terms.append(np.log(weight) + log_p - 0.5 * pt.sum(xi**2) - q)
        terms = pt.stack(log_terms)
        largest = disconnected_grad(pt.max(terms))
        log_sum = largest + pt.log(pt.sum(pt.exp(terms - largest)))
        return log_sum - pt.sum(pt.log(pt.diagonal(posterior.factor)))


def _posterior(observation: Seen) -> _Posterior:
    """The law of xi given the observation, N(0, I) before it."""
    chol = cholesky(observation.noise_cov, lower=True)
    jac = solve_triangular(chol, observation.jac, lower=True, b_ndim=2)
    residual = solve_triangular(chol, observation.residual, lower=True, b_ndim=1)
    factor = cholesky(pt.eye(jac.type.shape[1]) + jac.T @ jac, lower=True)
    half = solve_triangular(factor, jac.T @ residual, lower=True, b_ndim=1)
    return _Posterior(solve_triangular(factor.T, half, lower=False, b_ndim=1), factor)


def _datum(system: StateSpaceModel, d: TensorVariable) -> TensorVariable:
    """The datum; of distributions, a partly missing row counts as missing."""
    if system.gaussian_observation:
        return d
    return pt.switch(pt.any(pt.isnan(d)), np.nan, d)
