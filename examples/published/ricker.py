"""Ricker's map with Poisson counts: one run of a particle filter of others, and the exact value.

The R package pomp (6.4, ``ricker``) stores 51 counts, simulated, and tests a log-likelihood. The
log abundance falls to -40 and comes back within a few steps.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pymc as pm
import pytensor.tensor as pt
from comparison import Comparison, Study, cpu_seconds

import pymc_statespace_filters as psf

COUNTS = pd.read_csv(Path(__file__).parent / "data" / "ricker.csv").y.to_numpy(float)

# In the logarithm of the abundance N: N' = r N exp(-N + e).
ricker = psf.StateSpaceModel(
    transition=lambda x, q, log_r: [log_r + x[0] - pt.exp(x[0]) + q[0]],
    process_noise=[[0.3**2]],
    observation_dist=lambda x, phi: [pm.Poisson.dist(phi * pt.exp(x[0]))],
    initial_mean=[np.log(7.0)],
    initial_cov=[[0.0]],
)
TRUTH = {"log_r": 3.8, "phi": 10.0}


def study() -> Study:
    steps = np.arange(len(COUNTS))
    with cpu_seconds() as seconds:
        exact = psf.log_likelihood(ricker, psf.GridFilter(), TRUTH, COUNTS, steps=steps).sum()
        of_1000 = psf.log_likelihood(
            ricker, psf.BootstrapPF(1000), TRUTH, COUNTS, steps=steps, seed=np.arange(200)
        ).sum(axis=-1)
    return Study(
        "Ricker's map, 51 counts",
        "R package pomp 6.4, its own test",
        [Comparison("log-likelihood, one run of 1000 particles", -138.5, of_1000.std(), exact)],
        seconds[0],
        "Its error is the standard deviation of 200 such runs of ours. The log abundance falls to "
        "-40.",
    )
