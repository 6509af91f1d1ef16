"""Mean and covariance of an observation given the state, of a function or of distributions."""

from collections.abc import Callable, Mapping

import numpy as np
import pytensor.scalar as ps
import pytensor.tensor as pt
import pytensor.tensor.random.basic as ptr
from pytensor.tensor.elemwise import Elemwise
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.lowering.symbols import (
    SYMBOLS,
    observation_moments,
    symbols_of,
)
from pymc_statespace_filters.system.model import StateSpaceModel


def _negative_binomial(n, p):
    return n * (1 - p) / p, n * (1 - p) / p**2


def _beta_binomial(n, a, b):
    p, total = a / (a + b), a + b
    return n * p, n * p * (1 - p) * (total + n) / (total + 1)


def _beta(a, b):
    total = a + b
    return a / total, a * b / (total**2 * (total + 1))


def _student_t(nu, mu, sigma):
    return mu, pt.switch(nu > 2, sigma**2 * nu / (nu - 2), float("nan"))


def _inverse_gamma(a, b):
    mean = b / (a - 1)
    return mean, pt.switch(a > 2, mean**2 / (a - 2), float("nan"))


def _log_normal(mu, sigma):
    mean = pt.exp(mu + 0.5 * sigma**2)
    return mean, mean**2 * pt.expm1(sigma**2)


# Mean and variance by the parameters that PyMC's `dist` gives PyTensor's random variables.
MOMENTS: dict[type, Callable] = {
    ptr.BernoulliRV: lambda p: (p, p * (1 - p)),
    ptr.BetaBinomialRV: _beta_binomial,
    ptr.BetaRV: _beta,
    ptr.BinomialRV: lambda n, p: (n * p, n * p * (1 - p)),
    ptr.ExponentialRV: lambda mean: (mean, mean**2),
    ptr.GammaRV: lambda shape, scale: (shape * scale, shape * scale**2),
    ptr.GeometricRV: lambda p: (1 / p, (1 - p) / p**2),
    ptr.InvGammaRV: _inverse_gamma,
    ptr.LaplaceRV: lambda mu, b: (mu, 2 * b**2),
    ptr.LogNormalRV: _log_normal,
    ptr.LogisticRV: lambda mu, s: (mu, np.pi**2 / 3 * s**2),
    ptr.NegBinomialRV: _negative_binomial,
    ptr.NormalRV: lambda mu, sigma: (mu, sigma**2),
    ptr.PoissonRV: lambda mu: (mu, mu),
    ptr.StudentTRV: _student_t,
}


def conditional_moments(
    system: StateSpaceModel, symbols: Mapping[str, TensorVariable]
) -> tuple[TensorVariable, TensorVariable]:
    """E[d | x] and Cov[d | x]; noise inside a function is linearised at zero (Eq. 4.4)."""
    if system.gaussian_observation:
        return observation_moments(system, symbols)
    means, variances = zip(*map(_moments_of, _distributions(system, symbols)), strict=True)
    return pt.stack(means), pt.diag(pt.stack(variances))


def unknown_moments(system: StateSpaceModel) -> list[str]:
    """Distributions of the observables whose moments are not in the table, by name."""
    variables = _distributions(system, symbols_of(system))
    return [str(v.owner.op) for v in variables if type(v.owner.op) not in MOMENTS]


def _moments_of(variable: TensorVariable) -> tuple[TensorVariable, TensorVariable]:
    op = variable.owner.op
    parameters = [pt.cast(v, "float64") for v in op.dist_params(variable.owner)]
    mean, variance = MOMENTS[type(op)](*parameters)
    return pt.as_tensor(mean), pt.as_tensor(variance)


def _distributions(
    system: StateSpaceModel, symbols: Mapping[str, TensorVariable]
) -> list[TensorVariable]:
    """The random variables that the user's function returned, one per observable."""
    graph = system.equations.observation_draw
    assert graph is not None
    generators = [variable.type() for variable in graph.inputs[len(SYMBOLS) :]]
    given = symbols_of(system) | dict(symbols)
    (draw,) = graph.bind([*(given[name] for name in SYMBOLS), *generators])
    return [_without_cast(variable) for variable in draw.owner.inputs]


def _without_cast(variable: TensorVariable) -> TensorVariable:
    """The random variable in a stack of numbers of one type."""
    while isinstance(variable.owner.op, Elemwise) and isinstance(
        variable.owner.op.scalar_op, ps.Cast
    ):
        (variable,) = variable.owner.inputs
    return variable
