"""Kitagawa's growth model: the log-likelihood by two particle filters of others, and exactly.

Heng, Bishop, Deligiannidis and Doucet, "Controlled sequential Monte Carlo", Annals of Statistics 48
(2020), store 101 observations, simulated, and log-likelihoods at the parameters that made them.
"""

from pathlib import Path

import numpy as np
import pytensor.tensor as pt
from comparison import Comparison, Study, cpu_seconds, table

import pymc_statespace_filters as psf

OBSERVED = np.loadtxt(Path(__file__).parent / "data" / "kitagawa.csv")

growth = psf.StateSpaceModel(
    transition=lambda x, q, t: [
        x[0] / 2.0 + 25.0 * x[0] / (1.0 + x[0] ** 2) + 8.0 * pt.cos(1.2 * (t + 1.0)) + q[0]
    ],
    process_noise=[[10.0]],
    observation=lambda x: [x[0] ** 2 / 20.0],
    observation_noise=[[1.0]],
    initial_mean=[0.0],
    initial_cov=[[5.0]],
)


def study() -> Study:
    steps = np.arange(len(OBSERVED))
    with cpu_seconds() as seconds:
        exact = psf.log_likelihood(growth, psf.GridFilter(), {}, OBSERVED, steps=steps).sum()
    return Study(
        "growth model, 101 observations",
        "Heng et al. (2020), stored with their code",
        [
            Comparison("log-likelihood, bootstrap filter, one run", -250.637, 0.283, exact),
            Comparison("the same, controlled SMC, one run", -250.695, 0.143, exact),
        ],
        seconds[0],
        "The state has two modes.",
    )


if __name__ == "__main__":
    print(table([study()]))
