"""Populations with delay, and noise of three distributions, held to published log-likelihoods.

Nicholson's blowflies (1957, after Brillinger et al., 1980) and Ricker's map are examples of the R
package pomp 6.4 (``blowflies1``, ``blowflies2``, ``ricker``), which stores one run of a bootstrap
filter with 1000 particles for each.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf

RECORD = pd.read_csv(Path(__file__).parents[1] / "references" / "blowflies.csv")
DELAY = 14  # days


def blowflies(dt):
    """Adults N now and at every step of the last 14 days; recruits and survivors are counts."""

    def noise(x, P, delta, N0, sigma_P, sigma_d):
        recruitment = psf.gamma_white_noise(sigma_P, dt)
        mortality = psf.gamma_white_noise(sigma_d, dt)
        parents = x[-1]
        recruits = pm.Poisson.dist(P * parents * pt.exp(-parents / N0) * dt * recruitment)
        survivors = pm.Binomial.dist(x[0], pt.exp(-delta * dt * mortality))
        return [recruits, survivors]

    past = RECORD[RECORD.day <= DELAY]
    days = np.arange(DELAY, -1, -dt)
    n = len(days)
    return psf.StateSpaceModel(
        transition=lambda x, q: pt.concatenate([[q[0] + q[1]], x[:-1]]),
        process_dist=noise,
        dt=float(dt),
        observation_dist=lambda x, sigma_y: [pm.NegativeBinomial.dist(x[0], sigma_y**-2)],
        initial_mean=np.interp(days, past.day, past.y),
        initial_cov=np.zeros((n, n)),
    )


PUBLISHED = {
    1: (
        {"P": 3.2838, "delta": 0.16073, "N0": 679.94},
        {"sigma_P": 1.3512, "sigma_d": 0.74677, "sigma_y": 0.026649},
        -1467.82,
    ),
    2: (
        {"P": 2.7319, "delta": 0.17377, "N0": 800.31},
        {"sigma_P": 1.442, "sigma_d": 0.76033, "sigma_y": 0.010846},
        -1473.66,
    ),
}


@pytest.mark.filterwarnings("ignore:BootstrapPF:pymc_statespace_filters.FilterWarning")
@pytest.mark.parametrize("dt", PUBLISHED)
def test_blowflies(dt):
    """One published run against 40 of ours; a correct filter fails once in 700."""
    rates, noise, published = PUBLISHED[dt]
    later = RECORD[RECORD.day > DELAY]
    found = psf.log_likelihood(
        blowflies(dt),
        psf.BootstrapPF(1000),
        rates | noise,
        later.y.to_numpy(float),
        steps=((later.day - DELAY) // dt).to_numpy(),
        seed=np.arange(40),
    ).sum(axis=1)
    assert abs(published - found.mean()) < 3.2 * found.std(ddof=1)


RICKER = pd.read_csv(Path(__file__).parents[1] / "references" / "ricker.csv")
RICKER_SYSTEM = psf.StateSpaceModel(
    # In the logarithm of the density.
    transition=lambda x, q, r: [pt.log(r) + x[0] - pt.exp(x[0]) + q[0]],
    process_noise=[[0.3**2]],
    observation_dist=lambda x, phi: [pm.Poisson.dist(phi * pt.exp(x[0]))],
    initial_mean=[np.log(7.0)],
    initial_cov=[[0.0]],
)
RICKER_TRUTH = {"r": np.exp(3.8), "phi": 10.0}
RICKER_PUBLISHED = -138.5


def ricker(filter, seed=0):
    record = {"steps": np.arange(len(RICKER)), "seed": seed}
    terms = psf.log_likelihood(
        RICKER_SYSTEM, filter, RICKER_TRUTH, RICKER.y.to_numpy(float), **record
    )
    return terms.sum(axis=-1)


def test_ricker():
    """The published run, 200 of ours, and the exact value agree; fails once in 700."""
    exact = ricker(psf.GridFilter(tolerance=1e-4))
    found = ricker(psf.BootstrapPF(1000), np.arange(200))
    likelihoods = np.exp(found - exact)
    assert abs(likelihoods.mean() - 1.0) < 3.2 * likelihoods.std(ddof=1) / np.sqrt(200)
    assert abs(RICKER_PUBLISHED - found.mean()) < 3.2 * found.std(ddof=1)
