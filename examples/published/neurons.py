"""Thalamic neurons: 3000 binomial counts of spikes, likelihood and posterior without Monte Carlo.

Temereanca, Brown and Simons (2008) measured them; Heng, Bishop, Deligiannidis and Doucet,
"Controlled sequential Monte Carlo", Annals of Statistics 48 (2020), store log-likelihoods at 20
values of sigma^2 (means of 100 runs of controlled SMC with 128 particles) and report the posterior
of 100 000 iterations of particle Metropolis-Hastings.

The state is x' = alpha x + sigma e, and a count is Binomial(50, expit(x)). The posterior is a sum
over a grid of (alpha, log sigma^2), with a uniform prior of alpha in (0, 1) and the prior
InverseGamma(1, 0.1) of sigma^2.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pymc as pm
import pytensor.tensor as pt
from comparison import Comparison, Study, cpu_seconds, table
from scipy.stats import invgamma

import pymc_statespace_filters as psf

DATA = Path(__file__).parent / "data"
COUNTS = np.loadtxt(DATA / "neurons.csv")
STORED = pd.read_csv(DATA / "neurons_controlled_smc.csv")
N_RUNS = 100  # behind each stored number

neurons = psf.StateSpaceModel(
    transition=lambda x, q, alpha: [alpha * x[0] + q[0]],
    process_noise=lambda sigma2: [[sigma2]],
    observation_dist=lambda x: [pm.Binomial.dist(50, pt.sigmoid(x[0]))],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)


def log_likelihood(alpha, sigma2, tolerance=1e-8):
    exact, given = psf.GridFilter(tolerance=tolerance), {"alpha": alpha, "sigma2": sigma2}
    terms = psf.log_likelihood(neurons, exact, given, COUNTS, steps=np.arange(len(COUNTS)))
    return terms.sum(axis=-1)


def posterior() -> dict[str, tuple[float, float]]:
    """Mean and standard deviation of alpha and sigma^2."""
    alpha, log_sigma2 = np.linspace(0.9915, 0.99999, 24), np.log(0.1) + np.linspace(-0.5, 0.5, 25)
    a, s = (part.ravel() for part in np.meshgrid(alpha, np.exp(log_sigma2), indexing="ij"))
    log_density = log_likelihood(a, s, tolerance=1e-3)
    log_density += invgamma(1.0, scale=0.1).logpdf(s) + np.log(s)
    mass = np.exp(log_density - log_density.max())
    # Trapezoidal sums: the density is small at all ends but alpha = 1.
    mass *= np.where(a == alpha[-1], 0.5, 1.0)
    mass /= mass.sum()
    return {
        name: (mass @ x, np.sqrt(mass @ x**2 - (mass @ x) ** 2))
        for name, x in (("alpha", a), ("sigma2", s))
    }


def spread(filter, sigma2: float) -> float:
    """Standard deviation of the log-likelihood at alpha = 0.99 over runs of a particle filter."""
    given, steps = {"alpha": 0.99, "sigma2": sigma2}, np.arange(len(COUNTS))
    seeds = np.arange(N_RUNS)
    terms = psf.log_likelihood(neurons, filter, given, COUNTS, steps=steps, seed=seeds)
    return terms.sum(axis=-1).std(ddof=1)


def study() -> Study:
    with cpu_seconds() as seconds:
        ours = log_likelihood(0.99, STORED.sigma2.to_numpy())
        found = posterior()
        spreads = [spread(psf.GuidedPF(128), 0.12), spread(psf.BootstrapPF(5529), 0.12)]
    comparisons = [
        Comparison(
            f"log-likelihood at sigma^2 = {row.sigma2:g}", row.log_mean, row.sd / N_RUNS**0.5, value
        )
        for row, value in zip(STORED.itertuples(), ours, strict=True)
    ]
    # Of a chain of 100 000 that accepts a fifth: some 2000 independent draws.
    independent = 2000
    for name, mean, sd in (("alpha", 0.99802, 0.00102), ("sigma2", 0.1018, 0.0099)):
        for what, published, error, ours in (
            (f"posterior mean of {name}", mean, sd / independent**0.5, found[name][0]),
            ("its standard deviation", sd, sd / (2 * independent) ** 0.5, found[name][1]),
        ):
            comparisons.append(Comparison(what, published, error, ours, by_chance=False))
    return Study(
        "neurons, 3000 counts",
        "counts of Temereanca, Brown and Simons (2008); Heng, Bishop, Deligiannidis and Doucet, "
        "Annals of Statistics 48 (2020)",
        comparisons,
        seconds[0],
        "Their log-likelihoods are of 100 runs of controlled SMC with 128 particles, their "
        "posterior of 100 000 iterations of particle Metropolis-Hastings, whose error assumes 2000 "
        "independent draws. We took the priors alpha uniform and sigma^2 InverseGamma(1, 0.1). At "
        f"sigma^2 = 0.12 a run has the standard deviation {spreads[0]:.2f} with `GuidedPF(128)`, "
        "0.21 with their 128 particles in four passes; "
        f"{spreads[1]:.2f} with `BootstrapPF(5529)`, 0.60 with theirs.",
    )


if __name__ == "__main__":
    print(table([study()]))
