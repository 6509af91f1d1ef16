"""Distributions as functions of standard normals: their draws, means and variances.

A law of one number takes the parameters that PyMC's ``dist`` gives PyTensor's random variable. Its
``draw`` is exact; ``surrogate`` is a normal variable of the same mean and variance. Where a
parameter is invalid a draw is NaN.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytensor.tensor as pt
import pytensor.tensor.random.basic as ptr
from pymc.distributions.continuous import WeibullBetaRV
from pymc.distributions.discrete import DiscreteUniformRV
from pytensor.tensor.variable import TensorVariable

from ..quantiles import (
    bernoulli_quantile,
    binomial_quantile,
    gamma_quantile,
    normal_probability,
    poisson_quantile,
)

Moments = tuple[Any, Any]


_SD_OF_INFINITE_VARIANCE = pt.constant(1e200, dtype="float64")


class Domain(NamedTuple):
    """Which values a parameter may have, in words and as a condition on arrays and symbols."""

    text: str
    holds: Callable[[Any], Any]


REAL = Domain("a number", lambda v: v == v)
NON_NEGATIVE = Domain("at least 0", lambda v: v >= 0)
POSITIVE = Domain("above 0", lambda v: v > 0)
PROBABILITY = Domain("between 0 and 1", lambda v: (v >= 0) & (v <= 1))
COUNT = Domain("a whole number of at least 0", lambda v: (v >= 0) & (v % 1 == 0))


@dataclass(frozen=True)
class ScalarLaw:
    """A law of one number, or of an array of independent ones.

    ``quantile(z, ...)`` is a draw from ``n_normals`` normals z and the parameters, whose names and
    domains are ``domains``; unless it ``is_safe``, it is replaced by NaN outside of them.
    """

    moments: Callable[..., Moments]
    quantile: Callable[..., TensorVariable]
    domains: dict[str, Domain]
    n_normals: int = 1
    is_safe: bool = False
    is_discrete: bool = False
    is_gaussian: bool = False

    def count(self, shape: tuple[int, ...], parameters: Sequence[TensorVariable]) -> int:
        """How many normals an array of this shape takes."""
        return self.n_normals * int(np.prod(shape, dtype=int))

    def draw(
        self, z: TensorVariable, shape: tuple[int, ...], parameters: Sequence[TensorVariable]
    ) -> TensorVariable:
        """A draw from the normals ``z``."""
        normals = [z[i :: self.n_normals].reshape(shape) for i in range(self.n_normals)]
        drawn = self.quantile(*normals, *parameters)
        if self.is_safe:
            return drawn
        for domain, value in zip(self.domains.values(), parameters, strict=True):
            if domain is not REAL:
                drawn = pt.switch(domain.holds(value), drawn, np.nan)
        return drawn

    def surrogate(
        self, z: TensorVariable, shape: tuple[int, ...], parameters: Sequence[TensorVariable]
    ) -> TensorVariable:
        """Mean and standard deviation times a normal."""
        if self.is_gaussian:
            return self.draw(z, shape, parameters)
        mean, variance = self.moments(*parameters)
        return mean + root(variance) * z[:: self.n_normals].reshape(shape)


def root(variance: Any) -> TensorVariable:
    """The standard deviation, with a finite derivative at a variance of zero; zero below it.

    A Kalman update may leave a negative count, and so a negative variance. An infinite variance
    gives a number whose square overflows: a filter fails, and without noise the mean stays.
    """
    variance = pt.as_tensor(variance)
    has_none = variance <= 0
    sd = pt.minimum(pt.sqrt(pt.switch(has_none, 1.0, variance)), _SD_OF_INFINITE_VARIANCE)
    return pt.switch(has_none, 0.0, sd)


def _negative_binomial(n, p):
    return n * (1 - p) / p, n * (1 - p) / p**2


def _beta_binomial(n, a, b):
    p, total = a / (a + b), a + b
    return n * p, n * p * (1 - p) * (total + n) / (total + 1)


def _beta(a, b):
    total = a + b
    return a / total, a * b / (total**2 * (total + 1))


def _beta_draw(z_a, z_b, a, b):
    # 0 / 0 where both underflow, which needs shapes below 0.01.
    of_a = gamma_quantile(z_a, a, 1.0)
    return of_a / (of_a + gamma_quantile(z_b, b, 1.0))


def _discrete_uniform(lower, upper):
    return 0.5 * (lower + upper), ((upper - lower + 1) ** 2 - 1) / 12


def _geometric_draw(z, p):
    return pt.maximum(pt.ceil(_log_above(z) / pt.log1p(-p)), 1.0)


def _inverse_gamma(a, b):
    mean = pt.switch(a > 1, b / (a - 1), np.inf)
    return mean, pt.switch(a > 2, mean**2 / (a - 2), np.inf)


def _laplace_draw(z, mu, b):
    return mu - b * pt.switch(z < 0, -1.0, 1.0) * pt.log(2 * normal_probability(-abs(z)))


def _log_above(z):
    """The logarithm of a uniform number that falls with z."""
    return pt.log(normal_probability(-z))


def _log_normal(mu, sigma):
    mean = pt.exp(mu + 0.5 * sigma**2)
    return mean, mean**2 * pt.expm1(sigma**2)


def _student_t(nu, mu, sigma):
    return mu, pt.switch(nu > 2, sigma**2 * nu / (nu - 2), np.inf)


def _student_t_draw(z, z_scale, nu, mu, sigma):
    return mu + sigma * z * pt.sqrt(0.5 * nu / gamma_quantile(z_scale, 0.5 * nu, 1.0))


def _weibull(alpha, beta):
    first, second = (pt.exp(pt.gammaln(1 + i / alpha)) for i in (1, 2))
    return beta * first, beta**2 * (second - first**2)


_LOCATION_SCALE = {"mu": REAL, "sigma": NON_NEGATIVE}

SCALAR_LAWS: dict[type, ScalarLaw] = {
    ptr.BernoulliRV: ScalarLaw(
        lambda p: (p, p * (1 - p)),
        bernoulli_quantile,
        {"p": PROBABILITY},
        is_safe=True,
        is_discrete=True,
    ),
    ptr.BetaBinomialRV: ScalarLaw(
        _beta_binomial,
        lambda z, z_a, z_b, n, a, b: binomial_quantile(z, n, _beta_draw(z_a, z_b, a, b)),
        {"n": COUNT, "alpha": POSITIVE, "beta": POSITIVE},
        n_normals=3,
        is_safe=True,
        is_discrete=True,
    ),
    ptr.BetaRV: ScalarLaw(
        _beta, _beta_draw, {"alpha": POSITIVE, "beta": POSITIVE}, n_normals=2, is_safe=True
    ),
    ptr.BinomialRV: ScalarLaw(
        lambda n, p: (n * p, n * p * (1 - p)),
        binomial_quantile,
        {"n": COUNT, "p": PROBABILITY},
        is_safe=True,
        is_discrete=True,
    ),
    DiscreteUniformRV: ScalarLaw(
        _discrete_uniform,
        lambda z, lower, upper: pt.switch(
            lower <= upper,
            pt.minimum(lower + pt.floor((upper - lower + 1) * normal_probability(z)), upper),
            np.nan,
        ),
        {"lower": REAL, "upper": REAL},
        is_discrete=True,
    ),
    ptr.ExponentialRV: ScalarLaw(
        lambda mean: (mean, mean**2), lambda z, mean: -mean * _log_above(z), {"scale": NON_NEGATIVE}
    ),
    ptr.GammaRV: ScalarLaw(
        lambda shape, scale: (shape * scale, shape * scale**2),
        gamma_quantile,
        {"alpha": POSITIVE, "scale": NON_NEGATIVE},
        is_safe=True,
    ),
    ptr.GeometricRV: ScalarLaw(
        lambda p: (1 / p, (1 - p) / p**2), _geometric_draw, {"p": PROBABILITY}, is_discrete=True
    ),
    ptr.GumbelRV: ScalarLaw(
        lambda mu, beta: (mu + np.euler_gamma * beta, np.pi**2 / 6 * beta**2),
        lambda z, mu, beta: mu - beta * pt.log(-pt.log(normal_probability(z))),
        {"mu": REAL, "beta": NON_NEGATIVE},
    ),
    ptr.HalfNormalRV: ScalarLaw(
        lambda loc, sigma: (loc + np.sqrt(2 / np.pi) * sigma, (1 - 2 / np.pi) * sigma**2),
        lambda z, loc, sigma: loc + sigma * abs(z),
        {"loc": REAL, "sigma": NON_NEGATIVE},
    ),
    ptr.InvGammaRV: ScalarLaw(
        _inverse_gamma,
        lambda z, a, b: b / gamma_quantile(-z, a, 1.0),
        {"alpha": POSITIVE, "beta": NON_NEGATIVE},
    ),
    ptr.LaplaceRV: ScalarLaw(
        lambda mu, b: (mu, 2 * b**2), _laplace_draw, {"mu": REAL, "b": NON_NEGATIVE}
    ),
    ptr.LogNormalRV: ScalarLaw(
        _log_normal, lambda z, mu, sigma: pt.exp(mu + sigma * z), _LOCATION_SCALE
    ),
    ptr.LogisticRV: ScalarLaw(
        lambda mu, s: (mu, np.pi**2 / 3 * s**2),
        lambda z, mu, s: mu + s * (pt.log(normal_probability(z)) - _log_above(z)),
        {"mu": REAL, "s": NON_NEGATIVE},
    ),
    ptr.NegBinomialRV: ScalarLaw(
        _negative_binomial,
        lambda z, z_rate, n, p: poisson_quantile(z, gamma_quantile(z_rate, n, (1 - p) / p)),
        {"alpha": POSITIVE, "p": PROBABILITY},
        n_normals=2,
        is_safe=True,
        is_discrete=True,
    ),
    ptr.NormalRV: ScalarLaw(
        lambda mu, sigma: (mu, sigma**2),
        lambda z, mu, sigma: mu + sigma * z,
        _LOCATION_SCALE,
        is_gaussian=True,
    ),
    ptr.PoissonRV: ScalarLaw(
        lambda mu: (mu, mu), poisson_quantile, {"mu": NON_NEGATIVE}, is_safe=True, is_discrete=True
    ),
    ptr.StudentTRV: ScalarLaw(
        _student_t, _student_t_draw, {"nu": POSITIVE} | _LOCATION_SCALE, n_normals=2
    ),
    ptr.UniformRV: ScalarLaw(
        lambda lower, upper: (0.5 * (lower + upper), (upper - lower) ** 2 / 12),
        lambda z, lower, upper: pt.switch(
            lower <= upper, lower + (upper - lower) * normal_probability(z), np.nan
        ),
        {"lower": REAL, "upper": REAL},
    ),
    WeibullBetaRV: ScalarLaw(
        _weibull,
        lambda z, alpha, beta: beta * (-_log_above(z)) ** (1 / alpha),
        {"alpha": POSITIVE, "beta": NON_NEGATIVE},
    ),
}
