"""Lynx and hare: an ordinary differential equation and NUTS, against a reference posterior.

The model is that of B. Carpenter's case study (2018). posteriordb (``hudson_lynx_hare`` with
``lotka_volterra``; O. Järnefelt, 2020) stores means, their Monte Carlo errors and mean squares of
10 000 draws by Stan, ten chains thinned by ten. Their solver has the tolerances 1e-5 and 1e-3; ours
takes 20 Runge-Kutta steps a year.
"""

from pathlib import Path

import arviz as az
import numpy as np
import pandas as pd
import pymc as pm
import pytensor.tensor as pt
from comparison import Study, correlation_of_moments, cpu_seconds, moments, table

import pymc_statespace_filters as psf

DATA = Path(__file__).parents[2] / "docs" / "tutorials"
RECORD = pd.read_csv(DATA / "lynx_hare.csv")
STORED = pd.read_csv(DATA / "lynx_hare_published.csv", index_col="parameter")


def drift(x, alpha, beta, gamma, delta):
    return [(alpha - beta * x[1]) * x[0], (delta * x[0] - gamma) * x[1]]


pelts = psf.StateSpaceModel(
    transition=psf.RungeKutta4(drift, dt=0.05),
    observation=lambda x: [pt.log(x[0]), pt.log(x[1])],
    observation_noise=lambda sigma: pt.diag(sigma**2),
    initial_mean=lambda start: start,
    initial_cov=np.zeros((2, 2)),
    shapes={"sigma": (2,), "start": (2,)},
)


def posterior():
    with pm.Model(coords={"species": ["hare", "lynx"]}):
        pm.TruncatedNormal("alpha", 1, 0.5, lower=0)
        pm.TruncatedNormal("beta", 0.05, 0.05, lower=0)
        pm.TruncatedNormal("gamma", 1, 0.5, lower=0)
        pm.TruncatedNormal("delta", 0.05, 0.05, lower=0)
        pm.LogNormal("start", np.log(10), 1, dims="species")
        pm.LogNormal("sigma", -1, 1, dims="species")
        logs = np.log(RECORD[["hare", "lynx"]])
        psf.StateSpace("d", pelts, psf.EKF(), times=RECORD.year, t0=1900.0, observed=logs)
        starts = psf.find_starts(chains=4, random_seed=1, progressbar=False)
        return pm.sample(
            2500,
            chains=4,
            cores=1,
            init="adapt_diag",
            initvals=starts,
            nuts_sampler="pymc",
            random_seed=1,
            progressbar=False,
            quiet=True,
        )


def draws_of(posterior, label: str) -> np.ndarray:
    """Draws (chain, draw) of a scalar such as ``start[hare]``."""
    name, _, species = label.rstrip("]").partition("[")
    return (posterior[name].sel(species=species) if species else posterior[name]).values


def study() -> Study:
    with cpu_seconds() as seconds:
        idata = posterior()
    draws = {label: draws_of(idata["posterior"], label) for label in STORED.index}
    comparisons = []
    for row in STORED.itertuples():
        sd = np.sqrt(row.mean_square - row.mean**2)
        effective = (sd / row.mean_error) ** 2
        comparisons += moments(row.Index, draws[row.Index], row.mean, sd, effective)
    least = min(float(az.ess(x)) for x in draws.values())
    return Study(
        "lynx and hare, 21 years",
        "posteriordb, 10 000 draws by Stan (2020); model of B. Carpenter (2018)",
        comparisons,
        seconds[0],
        f"NUTS, four chains of 2500; {least / seconds[0]:.0f} effective draws per CPU second (the "
        "least of eight parameters), compilation included.",
        correlation_of_moments(draws.values()),
    )


if __name__ == "__main__":
    print(table([study()]))
