"""Which equation moves a particle between two wells? Three rivals, one noisy, sparse record.

A particle in a double-well potential is pushed by noise and seen every 0.2 seconds. The record was
made by ``dx = (4 x - 4 x^3) dt + 0.6 dW``; three models compete for it:

    M1: dx = (alpha x) dt + 0.6 dW + sigma_m dW_m
    M2: dx = (alpha x + beta x^3) dt + 0.6 dW + sigma_m dW_m
    M3: dx = (alpha x + beta x^3 + gamma x^5) dt + 0.6 dW + sigma_m dW_m

For each, the posterior is sampled by DRAM and the evidence estimated twice, by the method of Chib
and Jeliazkov and by bridge sampling. The table of model probabilities, with what the noise of the
computation leaves open, and pictures go to ``out/``; one of them is the drift as a curve, averaged
over the models. A record of your own, two columns time and value, takes the place of the simulated
one with ``--csv``.
"""

import argparse
from pathlib import Path

import arviz as az
import matplotlib
import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr

import pymc_statespace_filters as psf

matplotlib.use("Agg")
import matplotlib.pyplot as plt

DT = 0.01
NOISE_VARIANCE = 0.08
RECORD_SEED = 20


def drift(x, alpha, beta=0.0, gamma=0.0):
    return [alpha * x[0] + beta * x[0] ** 3 + gamma * x[0] ** 5]


def diffusion(sigma_m):
    return [[0.6, sigma_m]]


def position(x):
    return [x[0]]


double_well = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(drift, diffusion, dt=DT),
    observation=position,
    observation_noise=[[NOISE_VARIANCE]],
    initial_mean=[1.0],
    initial_cov=[[0.5]],
    states=["x"],
    observables=["position"],
)

RIVALS = {"M1": ("alpha",), "M2": ("alpha", "beta"), "M3": ("alpha", "beta", "gamma")}


def simulated_record(path: Path) -> None:
    """Write 101 observations of 20 seconds, in both wells, to a CSV of time and value."""
    truth = {"alpha": 4.0, "beta": -4.0, "sigma_m": 0.0}
    steps = np.arange(0, 2001, 20)
    record = psf.simulate(double_well, truth, steps=steps, random_seed=RECORD_SEED)
    values = record["observations"].values[:, 0]
    pd.DataFrame({"time": steps * DT, "value": values}).to_csv(path, index=False)


def read_record(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Steps and values of a CSV with the columns time and value; an empty value is missing."""
    try:
        table = pd.read_csv(path).iloc[:, :2]
        times, values = table.to_numpy(float).T
        return psf.nearest_steps(times, DT, t0=times[0]), values
    except (OSError, ValueError) as error:
        raise SystemExit(
            f"{path}: a header and two columns of numbers are needed: {error}"
        ) from None


def rival(coefficients: tuple[str, ...], filter, steps, values) -> pm.Model:
    """The PyMC model of one rival."""
    with pm.Model() as model:
        for name in coefficients:
            pm.Normal(name, 0, 10)
        pm.HalfNormal("sigma_m", 1)
        psf.StateSpace("d", double_well, filter, steps=steps, observed=values)
    return model


def filters(n_particles: int) -> dict:
    return {
        "bootstrap": psf.BootstrapPF(n_particles),
        "ekf": psf.EKF(),
        "enkf": psf.EnKF(n_particles),
        "pf_enkf": psf.PFEnKF(n_particles),
    }


def study(args: argparse.Namespace) -> pd.DataFrame:
    """Sample every rival, compute its evidence, write tables and pictures."""
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.csv or args.out / "record.csv"
    if args.csv is None:
        simulated_record(path)
    steps, values = read_record(path)
    results, summaries, estimates = {}, {}, {}
    for name, coefficients in RIVALS.items():
        model = rival(coefficients, filters(args.particles)[args.filter], steps, values)
        with model:
            idata = psf.sample_dram(
                args.draws,
                tune=args.tune,
                chains=args.chains,
                random_seed=args.seed,
                progressbar=args.progressbar,
            )
            found = psf.estimate_evidence(
                idata, random_seed=args.seed, progressbar=args.progressbar
            )
        results[name] = idata
        estimates[name] = found.to_dataframe()
        summaries[name] = az.summary(idata, var_names=[*coefficients, "sigma_m"])
    table = psf.compare_evidence(results, estimator="chib_jeliazkov")
    table.to_csv(args.out / "model_probabilities.csv")
    pd.concat(estimates, names=["model"]).to_csv(args.out / "evidences.csv")
    pd.concat(summaries, names=["model", "parameter"]).to_csv(args.out / "parameters.csv")
    draw(steps * DT, values, results, table, args.out / "double_well.png")
    average = psf.average_models(results, table, drift_curve, random_seed=args.seed)
    psf.plot_average(average).savefig(args.out / "drift.png")
    return table


def drift_curve(posterior: xr.Dataset) -> xr.DataArray:
    """The deterministic part of the motion at places between and around the wells."""
    places = np.linspace(-1.3, 1.3, 53)
    x = xr.DataArray(places, dims="position", coords={"position": places})
    powers = {"alpha": 1, "beta": 3, "gamma": 5}
    drift = sum(posterior[name] * x**n for name, n in powers.items() if name in posterior)
    return drift.rename("drift")


def draw(times, values, results: dict, table: pd.DataFrame, path: Path) -> None:
    """The record, the probabilities of the rivals, and the posterior of every parameter."""
    names = ["alpha", "beta", "gamma", "sigma_m"]
    figure, panels = plt.subplot_mosaic(
        [["record"] * 3 + ["probability"], names], figsize=(11, 5.5), layout="constrained"
    )
    panels["record"].plot(times, values, "ok", markersize=3)
    panels["record"].set(xlabel="time [s]", ylabel="position", title="The record")
    colours = dict(zip(results, ("C0", "C1", "C2"), strict=True))
    for name in names:
        for model, idata in results.items():
            if name in idata["posterior"]:
                # To equal height: a posterior ten times as narrow would hide the others.
                counts, edges = np.histogram(idata["posterior"][name], bins=40)
                height = counts / counts.max()
                panels[name].stairs(height, edges, label=model, color=colours[model], lw=1.5)
        panels[name].set(xlabel=name, yticks=[])
        panels[name].spines[["left", "right", "top"]].set_visible(False)
    panels["alpha"].legend(frameon=False, loc="upper right")
    panels["alpha"].set_ylabel("posterior, to equal height")
    table = table.sort_index()
    errors = [table["prob"] - table["prob_low"], table["prob_high"] - table["prob"]]
    panels["probability"].bar(
        table.index,
        table["prob"],
        yerr=np.clip(errors, 0, None),
        capsize=5,
        color=[colours[model] for model in table.index],
    )
    panels["probability"].set(title="Probability of each model", ylim=(0, 1.05))
    figure.savefig(path, dpi=150)
    plt.close(figure)


def arguments(argv: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--csv", type=Path, help="a record of your own: columns time, value")
    parser.add_argument("--filter", choices=list(filters(2)), default="bootstrap")
    parser.add_argument("--particles", type=int, default=256)
    parser.add_argument("--draws", type=int, default=8000)
    parser.add_argument("--tune", type=int, default=2000)
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true", help="a short form, for a first look")
    parser.add_argument("--no-progressbar", dest="progressbar", action="store_false")
    args = parser.parse_args(argv)
    if args.quick:
        args.filter, args.draws, args.tune, args.chains = "ekf", 1000, 1000, 2
    return args


if __name__ == "__main__":
    pd.set_option("display.width", 120, "display.max_columns", 20)
    print(study(arguments()).round(3))
