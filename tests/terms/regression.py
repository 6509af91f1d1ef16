"""Linear regression with known noise: every sub-model in closed form, or by a quadrature.

The coefficients have normal slabs of sd tau, the last one a half-normal slab; tau is 1, or unknown
with the prior HalfNormal(1). A half-normal slab has twice the evidence of a normal one times the
probability that the normal one gives to positive values.
"""

import itertools
from functools import cached_property

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import xarray as xr
from scipy.special import betaln, logsumexp
from scipy.stats import halfnorm, norm

import pymc_statespace_filters as psf

NODES = np.linspace(0.005, 6.0, 1000)  # of the quadrature over tau


def regression_system(n_terms):
    """The observable is the sum of b_i u_i, with a state that stays at zero."""
    return psf.StateSpaceModel(
        transition=lambda x, q: [x[0]],
        process_noise=[[1.0]],
        observation=lambda x, u, b: [x[0] + (b * u).sum()],
        observation_noise=[[1.0]],
        initial_mean=[0.0],
        initial_cov=[[0.0]],
        inputs=[f"u{i}" for i in range(n_terms)],
        shapes={"b": (n_terms,)},
    )


class Regression:
    """Data of a regression, drawn from the prior with sparse coefficients, and its sub-models."""

    def __init__(self, seed, n_terms=8, n=40, *, slab_unknown=False, collinear=0.9):
        rng = np.random.default_rng(seed)
        self.n_terms, self.slab_unknown = n_terms, slab_unknown
        self.inputs = rng.standard_normal((n, n_terms))
        self.inputs[:, 1] = collinear * self.inputs[:, 0] + 0.4 * self.inputs[:, 1]
        b = 0.4 * rng.standard_normal(n_terms) * (rng.random(n_terms) < 0.5)
        b[-1] = abs(b[-1])
        self.y = self.inputs @ b + rng.standard_normal(n)
        self.sets = np.array(list(itertools.product([False, True], repeat=n_terms)))
        self._xx, self._xy = self.inputs.T @ self.inputs, self.inputs.T @ self.y
        self._null = norm.logpdf(self.y).sum()

    def _posterior(self, present, tau):
        """Mean (..., s) and covariance (..., s, s) of the coefficients for known tau (...)."""
        scale = np.asarray(tau)[..., None, None]
        precision = self._xx[np.ix_(present, present)] + np.eye(present.sum()) / scale**2
        cov = np.linalg.inv(precision)
        return cov @ self._xy[present], cov

    def log_evidence_given(self, present, tau):
        """The log-evidence of a sub-model for known tau (...)."""
        if not present.any():
            return np.full(np.shape(tau), self._null)
        mean, cov = self._posterior(present, tau)
        found = self._null + 0.5 * mean @ self._xy[present]
        found += 0.5 * np.linalg.slogdet(cov)[1] - present.sum() * np.log(tau)
        if present[-1]:
            found += np.log(2) + norm.logcdf(mean[..., -1] / cov[..., -1, -1] ** 0.5)
        return found

    @cached_property
    def log_evidence(self):
        """Of all sub-models in the order of `sets`."""
        if not self.slab_unknown:
            return np.array([self.log_evidence_given(one, 1.0) for one in self.sets])
        prior = halfnorm.logpdf(NODES) + np.log(NODES[1] - NODES[0])
        by_tau = [self.log_evidence_given(one, NODES) for one in self.sets]
        # Close to zero the terms vanish, with the likelihood of none: the rest of the prior.
        rest = self._null + np.log(halfnorm.cdf(NODES[0] - (NODES[1] - NODES[0]) / 2))
        return np.logaddexp(logsumexp(np.array(by_tau) + prior, axis=1), rest)

    def inclusion(self):
        """Probabilities of inclusion under the beta-binomial prior."""
        size = self.sets.sum(axis=1)
        logs = self.log_evidence + betaln(size + 1, self.n_terms - size + 1)
        return np.exp(logs - logsumexp(logs)) @ self.sets

    def draws(self, seed, n_chains=2, n_draws=500):
        """Exact draws of the full model."""
        rng = np.random.default_rng(seed)
        every = np.ones(self.n_terms, dtype=bool)
        count = n_chains * n_draws
        taus = np.ones(count)
        if self.slab_unknown:
            logs = self.log_evidence_given(every, NODES) + halfnorm.logpdf(NODES)
            step = NODES[1] - NODES[0]
            taus = rng.choice(NODES, count, p=np.exp(logs - logsumexp(logs)))
            taus = taus + step * (rng.random(count) - 0.5)
        b = np.array([self._draw(every, tau, rng) for tau in taus])
        variables = {f"b{i}": one for i, one in enumerate(b.T)}
        if self.slab_unknown:
            variables["tau"] = taus
        shape = (n_chains, n_draws)
        posterior = {k: (("chain", "draw"), v.reshape(shape)) for k, v in variables.items()}
        coords = {"chain": np.arange(n_chains), "draw": np.arange(n_draws)}
        return xr.DataTree.from_dict({"posterior": xr.Dataset(posterior, coords=coords)})

    def _draw(self, present, tau, rng):
        mean, cov = self._posterior(present, tau)
        chol = np.linalg.cholesky(cov)
        while True:
            b = mean + chol @ rng.standard_normal(len(mean))
            if b[-1] > 0:
                return b

    def model(self, *, as_system=True, **of_last):
        """The full model; ``of_last`` are settings of the half-normal coefficient."""
        with pm.Model() as model:
            tau = pm.HalfNormal("tau", 1) if self.slab_unknown else 1.0
            b = [pm.Normal(f"b{i}", 0, tau) for i in range(self.n_terms - 1)]
            b.append(pm.HalfNormal(f"b{self.n_terms - 1}", tau, **of_last))
            if as_system:
                psf.StateSpace(
                    "y",
                    regression_system(self.n_terms),
                    psf.EKF(),
                    steps=np.arange(len(self.y)),
                    inputs=self.inputs,
                    params={"b": pt.stack(b)},
                    observed=self.y,
                )
            else:
                mean = sum(one * column for one, column in zip(b, self.inputs.T, strict=True))
                pm.Normal("y", mean, 1.0, observed=self.y)
        return model

    @property
    def absent(self):
        """All coefficients are candidates."""
        return {f"b{i}": 0.0 for i in range(self.n_terms)}
