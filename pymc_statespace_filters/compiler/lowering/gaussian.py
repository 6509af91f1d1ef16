"""Gaussian log-densities as graphs, with components left out."""

from collections.abc import Mapping

import numpy as np
import pytensor.tensor as pt
from pytensor.tensor.linalg import cholesky, solve_triangular
from pytensor.tensor.variable import TensorVariable

from ...system.model import StateSpaceModel
from ..numerics.small_cholesky import LOG_TWO_PI
from .symbols import call, observation_moments


def without_missing(
    datum: TensorVariable, mean: TensorVariable, cov: TensorVariable
) -> tuple[TensorVariable, TensorVariable, TensorVariable]:
    """Residual, covariance and indicator of what was seen; NaN in ``datum`` marks a missing one.

    A missing component gets residual 0 and an independent unit variance, so that it neither
    moves the state nor adds to a quadratic form or a log-determinant. The datum is replaced
    before it is used: a NaN multiplied by zero would survive in a gradient.
    """
    missing = pt.isnan(datum)
    residual = pt.switch(missing, 0.0, pt.switch(missing, 0.0, datum) - mean)
    either = missing[:, None] | missing[None, :]
    cov = pt.switch(either, np.eye(datum.type.shape[0]), cov)
    return residual, cov, 1.0 - pt.cast(missing, "float64")


def log_normal(
    residual: TensorVariable, cov: TensorVariable, seen: TensorVariable
) -> TensorVariable:
    """log N(residual; 0, cov) over the components with ``seen`` = 1; NaN if cov is not definite."""
    chol = cholesky(cov, lower=True)
    standardised = solve_triangular(chol, residual, lower=True, b_ndim=1)
    log_det = pt.sum(pt.log(pt.diagonal(chol)))
    return -0.5 * pt.sum(standardised**2) - log_det - 0.5 * LOG_TWO_PI * pt.sum(seen)


def observation_log_density(
    system: StateSpaceModel, symbols: Mapping[str, TensorVariable]
) -> TensorVariable:
    """log p(d | x); Gaussian noise through D Gamma D^T at e = 0 (Eqs. 4.4, 4.12)."""
    if system.equations.observation_logp is not None:
        return call(system.equations.observation_logp, system, symbols)
    mean, cov = observation_moments(system, symbols)
    return log_normal(*without_missing(symbols["d"], mean, cov))


def differentiable_log_density(
    system: StateSpaceModel, symbols: Mapping[str, TensorVariable]
) -> TensorVariable:
    """log p(d | x) with a gradient where data are missing.

    A missing datum of distributions is replaced, because its gradient would be NaN.
    """
    if system.equations.observation_draw is None:
        return observation_log_density(system, symbols)
    missing = pt.isnan(symbols["d"])
    datum = pt.switch(missing, 1.0, symbols["d"])
    there = observation_log_density(system, {**symbols, "d": datum})
    return pt.switch(pt.any(missing), 0.0, there)
