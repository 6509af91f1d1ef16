"""A linear-Gaussian state-space model of two parameters, with exact evidence and exact draws."""

from functools import cache

import numpy as np
import pymc as pm
from scipy.interpolate import PchipInterpolator, RectBivariateSpline
from scipy.stats import lognorm, norm

import pymc_statespace_filters as psf
from tests.evidence.targets import POSITIVE, REAL, Independent, Line, Target
from tests.systems import autoregression, simulated


class StateSpace(Target):
    """An autoregression seen with noise, phi and spread unknown; the EKF's likelihood is exact.

    Truth by quadrature in two dimensions; draws by quantiles of x_1, then of x_2 given x_1.
    """

    SYSTEM = autoregression()
    PHI, SPREAD = norm(0.5, 0.3), lognorm(0.5, scale=0.7)
    N_STEPS = 30
    ENDS = ((-1.0, 2.0), (-4.5, 2.5))

    def __init__(self, n_points=241):
        self.n_normals = 2
        self.prior = Independent((self.PHI, REAL), (self.SPREAD, POSITIVE))
        self.steps = np.arange(1, self.N_STEPS + 1)
        self.record = simulated(self.steps, 3, phi=0.8, spread=0.6)

        x, y = (np.linspace(*ends, n_points) for ends in self.ENDS)
        grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        log_joint = self.log_density(grid.reshape(-1, 2)).reshape(n_points, n_points)
        along = RectBivariateSpline(x, y, log_joint)
        lines = [Line(lambda t, x=x: along.ev(x, t), *self.ENDS[1], 2001) for x in x]
        log_marginal = np.array([line.log_integral for line in lines])
        self._line = Line(PchipInterpolator(x, log_marginal), *self.ENDS[0])
        self.log_evidence = self._line.log_integral
        z = np.linspace(-7.0, 7.0, 281)
        self._given = RectBivariateSpline(x, z, [line.quantile(z) for line in lines])

    def model(self, filter):
        """The same in PyMC, the likelihood by any filter."""
        with pm.Model() as model:
            pm.Normal("phi", *self.PHI.args)
            pm.LogNormal("spread", np.log(self.SPREAD.median()), *self.SPREAD.args)
            psf.StateSpace("d", self.SYSTEM, filter, steps=self.steps, observed=self.record)
        return model

    def log_likelihood(self, x):
        params = {"phi": x[:, 0], "spread": np.exp(x[:, 1])}
        terms = psf.log_likelihood(self.SYSTEM, psf.EKF(), params, self.record, steps=self.steps)
        return terms.sum(axis=-1)

    def transport(self, z):
        first = self._line.quantile(z[..., 0])
        return np.stack([first, self._given.ev(first, z[..., 1])], axis=-1)


@cache
def state_space():
    """The one that tests share: its quadrature takes seconds."""
    return StateSpace()
