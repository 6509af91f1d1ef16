"""Posteriors that are hard for every estimator, in many parameters, with a known evidence.

The posterior is given, and so is the evidence: the likelihood is the posterior density times the
evidence over the prior density.
"""

import numpy as np
from scipy.special import gammaln
from scipy.stats import norm

from tests.evidence.targets import Target, log_normal


class WideStudent:
    """A prior of independent Student variables, with tails heavier than those of any target."""

    DF, SCALE = 3.0, 3.0

    def __init__(self, k):
        self._k = k
        df = self.DF
        self._constant = (
            gammaln((df + 1) / 2) - gammaln(df / 2) - 0.5 * np.log(df * np.pi) - np.log(self.SCALE)
        )

    def log_density(self, x):
        square = (x / self.SCALE) ** 2 / self.DF
        return (self._constant - 0.5 * (self.DF + 1) * np.log1p(square)).sum(axis=-1)

    def sample(self, count, rng):
        return self.SCALE * rng.standard_t(self.DF, (count, self._k))


class Given(Target):
    """A posterior of k parameters by its normalised log-density and a map from k normals."""

    log_evidence = -7.5

    def __init__(self, k):
        self.k = self.n_normals = k
        self.prior = WideStudent(k)

    def log_posterior(self, x):
        """Normalised log-density of points (m, k)."""
        raise NotImplementedError

    def log_likelihood(self, x):
        return self.log_posterior(x) + self.log_evidence - self.prior.log_density(x)


class UnequalWidths(Given):
    """Two normal modes of standard deviations 0.3 and 0.15; the narrower one has a given mass."""

    SDS = np.array([0.3, 0.15])

    def __init__(self, k, narrow):
        super().__init__(k)
        self.n_normals = k + 1
        self._masses = np.array([1 - narrow, narrow])
        self._centres = np.array([-1.0, 1.0])

    def log_posterior(self, x):
        distances = x[:, None, :] - self._centres[:, None]
        log_each = log_normal(distances, self.SDS[:, None]).sum(axis=-1)
        return np.logaddexp(*(np.log(self._masses) + log_each).T)

    def transport(self, z):
        mode = (z[..., 0] > norm.ppf(self._masses[0])).astype(int)[..., None]
        return self._centres[mode] + self.SDS[mode] * z[..., 1:]


class Skewed(Given):
    """Independent parameters sinh(a asinh(z) + b): one tail long, heavier than normal."""

    TAIL, SKEW = 2.0, 1.0

    def log_posterior(self, x):
        y = (np.arcsinh(x) - self.SKEW) / self.TAIL
        z = np.sinh(y)
        log_slope = np.log(np.cosh(y)) - np.log(self.TAIL) - 0.5 * np.log1p(x**2)
        return (log_normal(z, 1.0) + log_slope).sum(axis=-1)

    def transport(self, z):
        return np.sinh(self.TAIL * np.arcsinh(z) + self.SKEW)


class Funnel(Given):
    """v ~ N(0, 3^2), and k - 1 further parameters ~ N(0, exp(v))."""

    SD = 3.0

    def log_posterior(self, x):
        v, others = x[:, :1], x[:, 1:]
        log_density = log_normal(others * np.exp(-0.5 * v), 1.0).sum(axis=-1)
        return log_density - 0.5 * others.shape[-1] * v[:, 0] + log_normal(v[:, 0], self.SD)

    def transport(self, z):
        v = self.SD * z[..., :1]
        return np.concatenate([v, np.exp(0.5 * v) * z[..., 1:]], axis=-1)


class Bent(Given):
    """The second parameter is the square of the first, up to a small error; others are normal."""

    SD, CURVATURE, WIDTH = 2.0, 1.0, 0.15

    def _middle(self, first):
        return self.CURVATURE * (first**2 - self.SD**2)

    def log_posterior(self, x):
        log_density = log_normal(x[:, 0], self.SD) + log_normal(x[:, 2:], 1.0).sum(axis=-1)
        return log_density + log_normal(x[:, 1] - self._middle(x[:, 0]), self.WIDTH)

    def transport(self, z):
        x = z.copy()
        x[..., 0] *= self.SD
        x[..., 1] = self._middle(x[..., 0]) + self.WIDTH * z[..., 1]
        return x


class Correlated(Given):
    """Normal, with the correlation 0.95 between neighbouring parameters."""

    def __init__(self, k):
        super().__init__(k)
        i = np.arange(k)
        self._chol = np.linalg.cholesky(0.95 ** np.abs(i[:, None] - i))
        self._inverse = np.linalg.inv(self._chol)

    def log_posterior(self, x):
        log_density = log_normal(x @ self._inverse.T, 1.0).sum(axis=-1)
        return log_density - np.log(np.diag(self._chol)).sum()

    def transport(self, z):
        return z @ self._chol.T
