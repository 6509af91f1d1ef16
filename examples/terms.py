"""Which of 20 terms are in the equations of a neuron? Three answers to one question.

The equations of FitzHugh and Nagumo for a voltage v and a recovery w, with noise,

    dv = (0.5 + v - v^3 / 3 - w) dt + 0.1 dW_1
    dw = (0.056 + 0.08 v - 0.064 w) dt + 0.1 dW_2

are simulated and both states measured with errors of 0.1. The candidates are all monomials to
degree three, ten for each equation; seven are there. The script compares

* `select_terms`: the probability of each term, averaged over sub-models;
* a regularised horseshoe (Piironen and Vehtari 2017), a prior that shrinks small coefficients,
  sampled by NUTS.

and writes ``out/terms.csv``, with pictures of the probabilities, ``out/terms.png``, and of how they
depend on the width of the priors, ``out/widths.png``. ``--quick`` has the linear candidates only,
three for each equation, and a hundred rows; the cubic term is then missing, as it may be in any
library.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr

import pymc_statespace_filters as psf

TRUTH = {
    "a": {"1": 0.5, "v": 1.0, "w": -1.0, "v^3": -1 / 3},
    "b": {"1": 0.056, "v": 0.08, "w": -0.064},
}
NOISE = 0.1


def neuron(terms) -> psf.StateSpaceModel:
    """The equations with all terms of a library."""

    def drift(x, a, b):
        return [a @ terms(x), b @ terms(x)]

    n = len(terms)
    return psf.StateSpaceModel(
        transition=psf.EulerMaruyama(drift, lambda s: [[s, 0.0], [0.0, s]], dt=0.05),
        observation=lambda x: [x[0], x[1]],
        observation_noise=lambda r: [[r**2, 0.0], [0.0, r**2]],
        initial_mean=[0.0, 0.0],
        initial_cov=[[1.0, 0.0], [0.0, 1.0]],
        states=terms.states,
        shapes={"a": (n,), "b": (n,)},
    )


def simulated(n_rows: int, seed: int) -> xr.Dataset:
    """The record: rows 0.1 apart, from the true equations."""
    cubic = psf.mechanics.polynomial_terms(["v", "w"], 3)
    values = {
        name: [present.get(term, 0.0) for term in cubic.names] for name, present in TRUTH.items()
    }
    steps = np.arange(0, 2 * n_rows, 2)
    return psf.simulate(
        neuron(cubic), values | {"s": NOISE, "r": NOISE}, steps=steps, random_seed=seed
    )


def full_model(terms, record: xr.Dataset, shrunk: bool) -> pm.Model:
    """All terms, with normal priors or a regularised horseshoe."""
    with pm.Model(coords={"term": terms.names}) as model:
        for name in TRUTH:
            (horseshoe if shrunk else slab)(name)
        pm.HalfNormal("s", 0.5)
        pm.HalfNormal("r", 0.5)
        observed = record["observations"].values
        steps = np.arange(0, 2 * len(observed), 2)
        psf.StateSpace("d", neuron(terms), psf.EKF(), steps=steps, observed=observed)
    return model


def slab(name: str) -> None:
    """Coefficients of about one."""
    pm.Normal(name, 0, 1, dims="term")


def horseshoe(name: str, scale: float = 0.1) -> None:
    """Coefficients near zero but for some, which are of about one; Piironen and Vehtari 2017."""
    tau = pm.HalfStudentT(f"{name}_tau", 3, scale)
    width = pm.HalfStudentT(f"{name}_width", 3, 1, dims="term")
    slab_2 = pm.InverseGamma(f"{name}_slab", 2, 2)
    sd = tau * width * (slab_2 / (slab_2 + (tau * width) ** 2)) ** 0.5
    pm.Deterministic(name, sd * pm.Normal(f"{name}_z", 0, 1, dims="term"), dims="term")


def study(args: argparse.Namespace) -> tuple[pd.DataFrame, xr.DataTree]:
    """Run the three methods; return a table of the terms, and the result of `select_terms`."""
    terms = psf.mechanics.polynomial_terms(["v", "w"], args.degree)
    record = simulated(args.rows, args.seed)
    settings = {"draws": args.draws, "tune": args.draws, "sampler": "nuts", "chains": args.chains}
    settings |= {"random_seed": args.seed, "progressbar": args.progressbar}
    settings["until_ess"] = None if args.quick else "auto"
    quiet = {"random_seed": args.seed, "progressbar": args.progressbar}
    seconds = {}

    began = time.process_time()
    model = full_model(terms, record, shrunk=False)
    idata = psf.sample(model=model, **settings)
    seconds["draws"] = time.process_time() - began

    began = time.process_time()
    selected = psf.select_terms(model, dict.fromkeys(TRUTH, 0.0), idata=idata, **quiet)
    seconds["select_terms"] = time.process_time() - began

    began = time.process_time()
    shrunk = psf.sample(model=full_model(terms, record, shrunk=True), **settings)
    seconds["horseshoe"] = time.process_time() - began

    drawn = np.concatenate([shrunk["posterior"][name].values for name in TRUTH], axis=-1)
    low, high = np.quantile(drawn.reshape(-1, drawn.shape[-1]), [0.05, 0.95], axis=0)
    table = pd.DataFrame(
        {
            "true": [TRUTH[name].get(term, 0.0) for name in TRUTH for term in terms.names],
            "inclusion": selected["terms"]["inclusion"],
            "se": selected["terms"]["inclusion_se"],
            "horseshoe 5 %": low,
            "95 %": high,
        },
        index=[f"{name}: {term}" for name in TRUTH for term in terms.names],
    )
    table.attrs["seconds"] = seconds
    return table, selected


def arguments(argv: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rows", type=int, default=500)
    parser.add_argument("--degree", type=int, default=3)
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true", help="a short form, to check that it runs")
    parser.add_argument("--no-progressbar", dest="progressbar", action="store_false")
    args = parser.parse_args(argv)
    if args.quick:
        args.rows, args.degree, args.draws, args.chains = 100, 1, 200, 2
    return args


if __name__ == "__main__":
    given = arguments()
    found, selected = study(given)
    given.out.mkdir(parents=True, exist_ok=True)
    found.to_csv(given.out / "terms.csv")
    psf.plot_terms(selected, backend="matplotlib").savefig(given.out / "terms.png")
    widths = psf.plot_prior_sensitivity(selected["widths"].to_dataset(), backend="matplotlib")
    widths.savefig(given.out / "widths.png")
    print(found.round(3).to_string())
    print("CPU seconds:", {name: round(one) for name, one in found.attrs["seconds"].items()})
