"""Red kangaroos: the evidence of a random walk and of exponential growth, by quadrature.

Caughley, Shepherd and Short (1987) counted two transects on each of 41 occasions; the counts are
those that Knape and de Valpine, Ecology 93 (2012), print with their program. A notebook of the
repository issxmeddine/Kangaroos stores log-evidences by their method: adaptive particle
Metropolis-Hastings, 25 000 iterations with 4000 particles, and importance sampling.

The state is the logarithm of the population, in which a step of any length is exact; the length is
an input. Priors: sigma and tau uniform on (0, 10), r on (-10, 10).
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pymc as pm
import pytensor.tensor as pt
from comparison import Comparison, Study, cpu_seconds, table
from scipy.special import logsumexp

import pymc_statespace_filters as psf

RECORD = pd.read_csv(Path(__file__).parents[2] / "docs" / "tutorials" / "kangaroos.csv")
COUNTS = RECORD[["first", "second"]].to_numpy(float)
YEARS = np.diff(RECORD.year)

# One number for each of their runs; a tenth of the second model failed.
RANDOM_WALK = [
    *(-543.6526331, -543.6560170, -543.6531663, -543.6605540, -543.6442668),
    *(-543.6601620, -543.6483302, -543.6457105, -543.6398562, -543.6659199),
]
EXPONENTIAL = [
    *(-547.5920684, -547.5862495, -547.5952352, -547.6218282, -547.6015667),
    *(-547.5834640, -547.5994993, -547.5852155, -547.6213061),
]

# They start at the mean of the first two counts, nearly known.
population = psf.StateSpaceModel(
    transition=lambda x, q, u, sigma, r=0.0: [x[0] + r * u[0] + sigma * pt.sqrt(u[0]) * q[0]],
    process_noise=[[1.0]],
    dt=1.0,  # an interval
    observation_dist=lambda x, tau: [
        pm.NegativeBinomial.dist(mu=pt.exp(x[0]), alpha=1.0 / tau) for _ in range(2)
    ],
    initial_mean=[np.log(COUNTS[0].mean())],
    initial_cov=[[0.01**2]],
    inputs=["years"],
)


def log_evidence(*, grows: bool) -> float:
    """A trapezoidal sum over log sigma, log tau and, in units of its error given sigma, r."""
    z = np.arange(-7.0, 8.0) if grows else np.zeros(1)
    mesh = np.meshgrid(np.linspace(-3.5, 1.5, 21), np.linspace(-5.5, 0.0, 21), z, indexing="ij")
    log_sigma, log_tau, z = (part.ravel() for part in mesh)
    sigma, tau = np.exp(log_sigma), np.exp(log_tau)
    error = sigma / YEARS.sum() ** 0.5
    terms = psf.log_likelihood(
        population,
        psf.GridFilter(tolerance=1e-5),
        {"sigma": sigma, "tau": tau, "r": z * error},
        COUNTS,
        steps=np.arange(len(COUNTS)),
        inputs=YEARS[:, np.newaxis],
    )
    volume = 0.25 * sigma * 0.275 * tau / 10.0**2
    if grows:
        volume *= error / 20.0
    return logsumexp(terms.sum(axis=-1), b=volume)


def study() -> Study:
    with cpu_seconds() as seconds:
        found = [log_evidence(grows=False), log_evidence(grows=True)]
    comparisons = []
    for name, runs, ours in zip(
        ("random walk", "exponential growth"), (RANDOM_WALK, EXPONENTIAL), found, strict=True
    ):
        error = np.std(runs, ddof=1) / len(runs) ** 0.5
        what = f"log-evidence of the {name}, {len(runs)} runs"
        comparisons.append(Comparison(what, np.mean(runs), error, ours))
    return Study(
        "red kangaroos, 41 pairs of counts",
        "counts of Caughley, Shepherd and Short (1987), after Knape and de Valpine, Ecology 93 "
        "(2012); evidences stored in the notebooks of issxmeddine/Kangaroos",
        comparisons,
        seconds[0],
        "Theirs are means of the runs, with their standard errors; ours are sums over a grid of "
        "the parameters. Of the logistic diffusion no evidence was found with an error.",
    )


if __name__ == "__main__":
    print(table([study()]))
