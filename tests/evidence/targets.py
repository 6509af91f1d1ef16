"""Posteriors whose evidence is known: each is the image of standard normals under a known map.

Independent normals become independent draws, and an autoregression of normals a chain that is
exactly stationary. So there is no sampler here, and no PyMC.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pymc as pm
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import PchipInterpolator
from scipy.linalg import solve
from scipy.signal import lfilter
from scipy.special import expit, log_expit, logit
from scipy.stats import gamma, halfnorm, multivariate_normal, norm, uniform

from pymc_statespace_filters.evidence.posterior import Posterior


def autoregressive(shape, correlation, rng):
    """Standard normals (chain, draw, k) whose lag-one correlation along the draws is as given."""
    innovations = rng.standard_normal(shape)
    innovations[:, 1:] *= np.sqrt(1 - correlation**2)
    return lfilter([1.0], [1.0, -correlation], innovations, axis=1)


class Scale(NamedTuple):
    """How the real line is mapped to the values of a parameter."""

    value: Callable[[np.ndarray], np.ndarray]
    inverse: Callable[[np.ndarray], np.ndarray]
    log_slope: Callable[[np.ndarray], np.ndarray]


REAL = Scale(np.asarray, np.asarray, np.zeros_like)
POSITIVE = Scale(np.exp, np.log, np.asarray)


def below(bound):
    """Between zero and a bound."""
    return Scale(
        lambda x: bound * expit(x),
        lambda v: logit(v / bound),
        lambda x: np.log(bound) + log_expit(x) + log_expit(-x),
    )


def log_normal(x, sd):
    """Log-density of N(0, sd^2): SciPy's takes five times as long, and this is all that is done."""
    return -0.5 * (x / sd) ** 2 - np.log(sd) - 0.5 * np.log(2 * np.pi)


class Normals:
    """A prior of independent normals, mean zero."""

    def __init__(self, sd):
        self._sd = np.asarray(sd)

    def log_density(self, x):
        return log_normal(x, self._sd).sum(axis=-1)

    def sample(self, count, rng):
        return self._sd * rng.standard_normal((count, len(self._sd)))


class Independent:
    """A prior of independent parameters: laws of SciPy, each with its scale."""

    def __init__(self, *parameters):
        self._parameters = parameters

    def log_density(self, x):
        return sum(
            law.logpdf(scale.value(x[:, i])) + scale.log_slope(x[:, i])
            for i, (law, scale) in enumerate(self._parameters)
        )

    def sample(self, count, rng):
        return np.column_stack(
            [scale.inverse(law.rvs(count, random_state=rng)) for law, scale in self._parameters]
        )


class Target:
    """A posterior, its evidence, and how to draw from it.

    Attributes
    ----------
    log_evidence : float
    prior : Prior
    n_normals : int
        Standard normals behind a draw.
    """

    def log_likelihood(self, x):
        """Of points (m, k), shape (m,)."""
        raise NotImplementedError

    def transport(self, z):
        """From standard normals (..., n_normals) to draws (..., k)."""
        raise NotImplementedError

    def log_density(self, x):
        return self.prior.log_density(x) + self.log_likelihood(x)

    def posterior(self, shape, rng, *, correlation=0.0, noise_sd=0.0):
        """Chains of shape (chain, draw), stationary from the first draw on.

        With noise, they have the law of a pseudo-marginal chain: estimates of the likelihood have
        log-noise N(-sd^2/2, sd^2), so that their mean is exact, and those that the chain stores
        are tilted by the exponential of it, N(+sd^2/2, sd^2).
        """
        draws = self.transport(autoregressive((*shape, self.n_normals), correlation, rng))
        stored = self.log_density(draws.reshape(-1, draws.shape[-1])).reshape(shape)
        if noise_sd:
            noise = autoregressive((*shape, 1), correlation, rng)[..., 0]
            stored = stored + noise_sd**2 / 2 + noise_sd * noise

        def evaluate(x, rng):
            return self.log_density(x) + rng.normal(-(noise_sd**2) / 2, noise_sd, len(x))

        return Posterior(draws, stored, evaluate, is_noisy=noise_sd > 0, prior=self.prior)


class Regression(Target):
    """y = X w + N(0, sd^2), w ~ N(0, scale^2): posterior and evidence in closed form."""

    def __init__(self, k, n, rng, *, sd=0.5, scale=2.0):
        self.x = np.column_stack([np.ones(n), rng.standard_normal((n, k - 1))])
        self.y = self.x @ rng.standard_normal(k) + sd * rng.standard_normal(n)
        self.sd, self.scale = sd, scale
        precision = self.x.T @ self.x / sd**2 + np.eye(k) / scale**2
        self.mean = solve(precision, self.x.T @ self.y / sd**2)
        self.chol = np.linalg.cholesky(np.linalg.inv(precision))
        marginal = scale**2 * self.x @ self.x.T + sd**2 * np.eye(n)
        self.log_evidence = multivariate_normal(np.zeros(n), marginal).logpdf(self.y)
        self.prior = Normals([scale] * k)
        self.n_normals = k

    def model(self, shift=0.0):
        """The same in PyMC, of data moved by ``shift``."""
        with pm.Model() as model:
            w = pm.Normal("w", 0, self.scale, shape=self.n_normals)
            # PyTensor takes twenty seconds to compile the product x @ w.
            pm.Normal("y", (self.x * w).sum(axis=1), self.sd, observed=self.y + shift)
        return model

    def log_likelihood(self, x):
        return log_normal(self.y - x @ self.x.T, self.sd).sum(axis=-1)

    def transport(self, z):
        return self.mean + z @ self.chol.T


class TwoModes(Target):
    """One vector y = 0 of unknown origin: y = x - c + N(0, s^2) for either of two (c, s).

    The modes are five deviations apart, of unequal weight and width. The first of the normals says
    in which of them a draw lies, so that chains go to and fro.
    """

    SCALE = 4.0  # of the prior
    CENTRES = np.array([[-2.5, -2.5, -2.5], [2.5, 2.5, 2.5]])
    SDS = np.array([1.0, 0.6])
    WEIGHTS = np.array([0.3, 0.7])

    def __init__(self, k):
        self._centres = self.CENTRES[:, :k]
        marginal_sd = np.sqrt(self.SDS**2 + self.SCALE**2)[:, None]
        self._log_each = np.log(self.WEIGHTS) + log_normal(self._centres, marginal_sd).sum(axis=1)
        self.log_evidence = np.logaddexp(*self._log_each)
        self.prior = Normals([self.SCALE] * k)
        self.n_normals = k + 1

    def log_likelihood(self, x):
        distances = x[:, None, :] - self._centres
        log_each = log_normal(distances, self.SDS[:, None]).sum(axis=-1)
        return np.logaddexp(*(np.log(self.WEIGHTS) + log_each).T)

    def transport(self, z):
        first = norm.ppf(np.exp(self._log_each[0] - self.log_evidence))
        mode = (z[..., 0] > first).astype(int)
        shrinkage = self.SCALE**2 / (self.SCALE**2 + self.SDS**2)
        mean = shrinkage[:, None] * self._centres
        sd = self.SDS * np.sqrt(shrinkage)
        return mean[mode] + sd[mode][..., None] * z[..., 1:]


class Line:
    """A density of one number, its integral, and draws from it, all by quadrature.

    The density must vanish at both ends: then the trapezoidal sum converges faster than any power
    of the spacing.
    """

    def __init__(self, log_density, low, high, n_points=20_001):
        x = np.linspace(low, high, n_points)
        log_density = log_density(x)
        peak = log_density.max()
        density = np.exp(log_density - peak)
        self.log_integral = peak + np.log(np.trapezoid(density, x))
        # Quantiles of the standard normal law, from either side so that no tail loses its digits.
        from_below = cumulative_trapezoid(density, x, initial=0)
        from_above = -cumulative_trapezoid(density[::-1], x[::-1], initial=0)[::-1]
        total = from_below[-1]
        z = np.where(
            2 * from_below < total, norm.ppf(from_below / total), norm.isf(from_above / total)
        )
        inside = np.abs(z) < 8
        self.quantile = PchipInterpolator(z[inside], x[inside])


class StandardDeviation(Target):
    """y ~ N(0, s^2) with s alone unknown, on the scale of a transform; truth by quadrature."""

    Y = np.array([0.4, -1.1, 0.6, 1.9, -0.2])
    ENDS = (-8.0, 40.0)

    def __init__(self, law, scale):
        self._scale = scale
        self.prior = Independent((law, scale))
        self._line = Line(lambda x: self.log_density(x[:, None]), *self.ENDS)
        self.log_evidence = self._line.log_integral
        self.n_normals = 1

    def log_likelihood(self, x):
        return log_normal(self.Y, self._scale.value(x)).sum(axis=-1)

    def transport(self, z):
        return self._line.quantile(z)


def half_normally_distributed():
    return StandardDeviation(halfnorm(scale=2.0), POSITIVE)


def gamma_distributed():
    return StandardDeviation(gamma(2.0, scale=0.5), POSITIVE)


def bounded():
    """The data ask for more than the bound, where the posterior therefore has its mass."""
    return StandardDeviation(uniform(0.0, 0.9), below(0.9))


class Banana(Target):
    """y_1 = x_2 + x_1^2 + N(0, 0.4^2), and y_j = x_j + N(0, 0.4^2) for the other parameters.

    Given x_1, a regression; the rest is an integral over one number.
    """

    SD, SCALE = 0.4, np.array([1.0, 3.0])  # of the observations; of the prior of x_1, of all others

    def __init__(self, k):
        self.n_normals = k
        self._y = np.concatenate([[0.5], np.linspace(-2.0, 2.0, k - 2)])
        self._prior_sd = np.repeat(self.SCALE, [1, k - 1])
        self.prior = Normals(self._prior_sd)
        self._line = Line(self._log_marginal, -7.0, 7.0)
        self.log_evidence = self._line.log_integral

    def _log_marginal(self, first):
        """Log joint density of x_1 and the data."""
        sd = np.hypot(self.SD, self.SCALE[1])
        log_density = log_normal(first, self.SCALE[0])
        log_density += log_normal(self._y[0] - first**2, sd)
        return log_density + log_normal(self._y[1:], sd).sum()

    def log_likelihood(self, x):
        mean = x[:, 1:].copy()
        mean[:, 0] += x[:, 0] ** 2
        return log_normal(self._y - mean, self.SD).sum(axis=-1)

    def transport(self, z):
        first = self._line.quantile(z[..., 0])
        seen = np.broadcast_to(self._y, z[..., 1:].shape).copy()
        seen[..., 0] -= first**2
        shrinkage = self.SCALE[1] ** 2 / (self.SCALE[1] ** 2 + self.SD**2)
        others = shrinkage * seen + self.SD * np.sqrt(shrinkage) * z[..., 1:]
        return np.concatenate([first[..., None], others], axis=-1)
