"""One parameter, a linear system, and everything about it by quadrature: scores, posteriors."""

from functools import cache

import arviz as az
import numpy as np
import pymc as pm
from scipy.integrate import cumulative_trapezoid
from scipy.special import logsumexp
from scipy.stats import norm

import pymc_statespace_filters as psf
from tests.systems import autoregression, simulated

SYSTEM = autoregression()
SPREAD = 0.7
PRIOR = norm(0.4, 0.4)
PHI = np.linspace(PRIOR.ppf(1e-12), PRIOR.isf(1e-12), 1201)
STEPS = np.arange(1, 25)
MISSING = 7  # the row of the record that is wholly missing


@cache
def record():
    observed = simulated(STEPS, 4, phi=0.7, spread=SPREAD)
    observed[MISSING] = np.nan
    return observed


def model_with(filter):
    with pm.Model() as model:
        pm.Normal("phi", *PRIOR.args)
        known = {"spread": SPREAD}
        psf.StateSpace("d", SYSTEM, filter, params=known, steps=STEPS, observed=record())
    return model


@cache
def log_joint():
    """Log-density (J + 1, points of PHI) of phi and the first j rows."""
    terms = psf.log_likelihood(
        SYSTEM, psf.EKF(), {"phi": PHI, "spread": SPREAD}, record(), steps=STEPS
    )
    return PRIOR.logpdf(PHI) + np.cumsum(np.insert(terms, 0, 0.0, axis=1), axis=1).T


@cache
def log_evidences():
    """Of the first j rows, j from 0 to J."""
    return logsumexp(log_joint(), axis=1) + np.log(PHI[1] - PHI[0])


@cache
def scores():
    """log p(d_j | d_1 .. d_{j-1}) of every row that is seen, phi integrated out."""
    return np.delete(np.diff(log_evidences()), MISSING)


def posterior_draws(n_rows, rng, shape=(4, 1000)):
    """Quantiles of phi given the first rows, evenly spaced: draws without their scatter."""
    density = np.exp(log_joint()[n_rows] - log_joint()[n_rows].max())
    below = cumulative_trapezoid(density, PHI, initial=0)
    levels = rng.permutation((np.arange(np.prod(shape)) + 0.5) / np.prod(shape))
    phi = np.interp(levels, below / below[-1], PHI)
    return az.from_dict({"posterior": {"phi": phi.reshape(shape)}})


def noisy_draws(filter, n_rows, rng, shape=(4, 1000)):
    """Independent draws of phi together with the seed of its estimate, given the first rows."""
    n_candidates = 10 * shape[0] * shape[1]
    phi = PRIOR.rvs(n_candidates, random_state=rng)
    seeds = rng.integers(2**62, size=n_candidates)
    observed, steps = record()[:n_rows], STEPS[:n_rows]
    params = {"phi": phi, "spread": SPREAD}
    terms = psf.log_likelihood(SYSTEM, filter, params, observed, steps=steps, seed=seeds)
    log_weights = terms.sum(axis=1)
    weights = np.exp(log_weights - logsumexp(log_weights))
    # Systematic: nothing of the weights is left to chance but fractions.
    places = (np.arange(shape[0] * shape[1]) + rng.uniform()) / (shape[0] * shape[1])
    chosen = rng.permutation(np.searchsorted(np.cumsum(weights), places)).reshape(shape)
    return az.from_dict(
        {"posterior": {"phi": phi[chosen]}, "sample_stats": {"d_seed": seeds[chosen]}}
    )
