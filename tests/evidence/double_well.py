"""A particle in a double well, two parameters with proper priors, and its exact evidence.

The likelihood of the discretised equation is that of the grid filter, to a millionth; the rest is a
sum over a lattice of parameters, where the joint density vanishes at all ends.
"""

from functools import cache

import numpy as np
import pymc as pm
from scipy.stats import lognorm, norm

import pymc_statespace_filters as psf

ALPHA, BETA = norm(3.0, 2.0), lognorm(0.5, scale=3.0)
STEPS = np.arange(0, 401, 16)  # ten seconds, 26 observations
# Beyond these ends of alpha and ln beta the joint density is below a millionth of its peak.
ENDS = ((-3.0, 10.0), (-1.1, 3.1))


def drift(x, alpha, beta):
    return [alpha * x[0] - beta * x[0] ** 3]


def diffusion():
    return [[0.8]]


def position(x):
    return [x[0]]


SYSTEM = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(drift, diffusion, dt=0.025),
    observation=position,
    observation_noise=[[0.04]],
    initial_mean=[1.0],
    initial_cov=[[0.1]],
)


@cache
def record():
    """The seed was chosen for a record that crosses the barrier three times."""
    truth = {"alpha": 3.0, "beta": 3.0}
    return psf.simulate(SYSTEM, truth, steps=STEPS, random_seed=5)["observations"].values


def log_evidence(n_points):
    """By trapezoidal sums over n_points^2 parameters, some milliseconds each."""
    alpha, log_beta = np.meshgrid(*(np.linspace(*ends, n_points) for ends in ENDS), indexing="ij")
    terms = psf.log_likelihood(
        SYSTEM,
        psf.GridFilter(tolerance=1e-6),
        {"alpha": alpha, "beta": np.exp(log_beta)},
        record(),
        steps=STEPS,
    )
    log_joint = terms.sum(axis=-1) + ALPHA.logpdf(alpha)
    log_joint += BETA.logpdf(np.exp(log_beta)) + log_beta
    cell = np.prod(np.ptp(ENDS, axis=1) / (n_points - 1))
    peak = log_joint.max()
    return peak + np.log(np.exp(log_joint - peak).sum() * cell)


LOG_EVIDENCE = -17.097125  # of 49 points a side; 25 give the same to a millionth


def model(filter):
    """The same in PyMC."""
    with pm.Model() as model:
        pm.Normal("alpha", *ALPHA.args)
        pm.LogNormal("beta", np.log(BETA.median()), BETA.args[0])
        psf.StateSpace("d", SYSTEM, filter, steps=STEPS, observed=record())
    return model
