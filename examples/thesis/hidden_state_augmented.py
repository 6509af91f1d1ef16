"""Can a filter by itself estimate the parameters of a record? They are states that do not change.

The system is the double well dx = (alpha x + beta x^3) dt + 0.6 dW with a record of twenty seconds.
alpha and beta are two more states without noise (Eq. 4.46 along a record). Each filter passes over
the record once. The reference is the posterior, sampled with the exact likelihood of `GridFilter`
under a prior equal to the initial distribution of the augmented state.
"""

import time

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr
from hidden_state_pictures import draw_estimates
from scipy.stats import norm, wasserstein_distance
from study import Study

import pymc_statespace_filters as psf

DT, NOISE_VARIANCE = 0.01, 0.08
TRUTH = {"alpha": 4.0, "beta": -4.0}
# More than a standard deviation from the truth, so that there is something to learn. A positive
# beta sends the state to infinity, and one such member ruins an ensemble's covariance: it is
# improbable here.
PRIOR = {"alpha": (6.0, 1.5), "beta": (-6.0, 1.5)}
STEPS = np.arange(0, 2001, 20)
# The record must visit both wells; seven is the first seed with a twentieth of the record in each.
RECORD_SEED = 7


def drift(x, alpha, beta):
    return [alpha * x[0] + beta * x[0] ** 3]


def augmented_drift(x):
    alpha, beta = x[1], x[2]
    return [*drift(x, alpha, beta), 0.0 * alpha, 0.0 * beta]


OBSERVED = {"observation": lambda x: [x[0]], "observation_noise": [[NOISE_VARIANCE]]}

double_well = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(drift, [[0.6]], dt=DT),
    initial_mean=[1.0],
    initial_cov=[[0.5]],
    **OBSERVED,
)
augmented = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(augmented_drift, [[0.6], [0.0], [0.0]], dt=DT),
    initial_mean=[1.0, *(mean for mean, _ in PRIOR.values())],
    initial_cov=np.diag([0.5, *(sd**2 for _, sd in PRIOR.values())]),
    states=["x", *PRIOR],
    **OBSERVED,
)


def sampled_posterior(settings: Study, record: np.ndarray) -> tuple[xr.Dataset, float]:
    """Return draws of the exact posterior, and the computing time (missing in a resumed run)."""
    sampling = settings.sampling("augmented")
    resumed = sampling["checkpoint"].exists()
    with pm.Model():
        for name, (mean, sd) in PRIOR.items():
            pm.Normal(name, mean, sd)
        psf.StateSpace("d", double_well, psf.GridFilter(), steps=STEPS, observed=record)
        begin = time.process_time()
        idata = psf.sample_dram(**sampling)
    seconds = np.nan if resumed else time.process_time() - begin
    return idata["posterior"].to_dataset(), seconds


def passes(filter, record: np.ndarray, seeds: range) -> tuple[list[xr.Dataset], float]:
    """Pass over the record once per seed, if seeds matter; also return the seconds of one.

    Passes that fail are left out: in one of 40, parameters of a member of the EnKF make it explode,
    and with it the covariance.
    """
    seeds = seeds if filter.noisy else seeds[:1]

    def one(seed: int) -> xr.Dataset:
        return psf.run_filter(augmented, filter, {}, record, steps=STEPS, seed=seed)

    one(seeds[0])  # compiles
    begin = time.process_time()
    runs = [one(seed) for seed in seeds]
    seconds = (time.process_time() - begin) / len(runs)
    return [run for run in runs if np.isfinite(run["mean"].values[-1]).all()], seconds


def summary(values: np.ndarray, weights: np.ndarray, draws: xr.DataArray) -> dict:
    """Return mean, sd, 90 % interval and distance from the posterior of a weighted sample."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order]) / np.sum(weights)
    mean = np.average(values, weights=weights)
    return {
        "mean": mean,
        "sd": np.sqrt(np.average((values - mean) ** 2, weights=weights)),
        "5 %": values[order][np.searchsorted(reached, 0.05)],
        "95 %": values[order][np.searchsorted(reached, 0.95)],
        "distance": wasserstein_distance(values, draws.values.ravel(), weights),
    }


def last_values(run: xr.Dataset, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return values and weights of a parameter at the end of the record."""
    last = run.isel(time=-1).sel(state=name)
    if "particles" in last:
        return last["particles"].values, last["weights"].values
    places = np.linspace(-8.0, 8.0, 2001)
    values = float(last["mean"]) + float(last["sd"]) * places
    return values, norm.pdf(places)


def row_of(runs: list[xr.Dataset], name: str, draws: xr.DataArray, seconds: float) -> dict:
    """Return a filter's results for a parameter, over all seeds, and those of its posterior."""
    several = pd.DataFrame([summary(*last_values(run, name), draws) for run in runs])
    row = several.mean().to_dict() | {"± mean": several["mean"].std(ddof=0)}
    distinct = np.nan
    if "particles" in runs[0]:
        distinct = np.mean([np.unique(last_values(run, name)[0]).size for run in runs])
    return row | {"runs": len(runs), "distinct values": distinct, "seconds": seconds}


def augmented_study(settings: Study, filters: dict) -> pd.DataFrame:
    """Write the table and the figure of parameters as states."""
    simulated = psf.simulate(double_well, TRUTH, steps=STEPS, random_seed=RECORD_SEED)
    record = simulated["observations"].values
    if min(np.mean(record < -0.5), np.mean(record > 0.5)) < 0.05:
        raise SystemExit("the record must visit both wells")
    posterior, seconds = sampled_posterior(settings, record)
    rows = {}
    for name in TRUTH:
        values = posterior[name].values.ravel()
        found = summary(values, np.ones(values.size), posterior[name])
        rows[name, "posterior"] = found | {"seconds": seconds}
    runs, seeds = {}, range(settings.seed, settings.seed + (4 if settings.quick else 20))
    for filter_name, filter in filters.items():
        runs[filter_name], seconds = passes(filter, record, seeds)
        for name in TRUTH:
            rows[name, filter_name] = row_of(runs[filter_name], name, posterior[name], seconds)
    table = (
        pd.DataFrame(rows)
        .T.rename_axis(["parameter", "by"])
        .sort_index(level=0, sort_remaining=False)
    )
    order = ["mean", "± mean", "sd", "5 %", "95 %", "distance"]
    order += ["runs", "distinct values", "seconds"]
    settings.table("augmented", table[order], digits=3)
    few = {name: several[:5] for name, several in runs.items()}
    settings.picture("augmented", draw_estimates(few, posterior, TRUTH))
    check(table, settings.particles)
    return table


def check(table: pd.DataFrame, particles: int) -> None:
    """Stop unless the table supports the claims of the page."""
    for name in TRUTH:
        found = table.loc[name]
        if found["distinct values"]["BootstrapPF"] > 0.02 * particles:
            raise SystemExit(f"BootstrapPF must lose the variety of {name}")
        for filter_name in ("BootstrapPF", "PFEnKF"):
            if found["distance"][filter_name] < 2 * found["distance"]["EnKF"]:
                raise SystemExit(f"{filter_name} must be further off than EnKF in {name}")
            if found["sd"][filter_name] > found["sd"]["posterior"]:
                raise SystemExit(f"{filter_name} must be too sure of {name}")
