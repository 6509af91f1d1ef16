"""Filters of the oscillator at the truth: with kinks and rounded, with and without memory."""

from dataclasses import replace

import numpy as np
import pandas as pd
import xarray as xr
from oscillator import CASES, TRUTH, Case, oscillator, restoring_force

import pymc_statespace_filters as psf

WIDTHS = (0.02, 0.05, 0.1, 0.2, 0.4)
N_SEEDS = 8  # for a filter with noise
PULLED_OUT = 2.5  # m, beyond the end of the loop, a_h + delta_h = 2 m


def log_likelihoods(case: Case, filter, parameters, *, width=None, seed=0) -> np.ndarray:
    """Return log-likelihoods of a case's record at parameters (numbers or arrays)."""
    terms = psf.log_likelihood(
        oscillator(memory=case.memory, width=width),
        filter,
        parameters | case.known,
        case.record()["observations"].values,
        steps=case.steps,
        inputs=case.inputs,
        seed=seed,
    )
    return terms.sum(axis=-1)


def cost_of_rounding() -> pd.DataFrame:
    """Return the errors of rounded kinks in the force, and in the log-likelihood by EKF."""
    u = np.linspace(-2.5, 2.5, 5001)
    rows = []
    for width in WIDTHS:
        errors = [
            np.abs(restoring_force(u, way, TRUTH, width=width) - restoring_force(u, way, TRUTH))
            for way in (1.0, -1.0)
        ]
        row = {"width [m]": width, "force [N]": np.max(errors)}
        for name, case in CASES.items():
            if not case.memory:
                exact, rounded = (
                    log_likelihoods(case, psf.EKF(), TRUTH, width=w) for w in (None, width)
                )
                row[f"log-likelihood, {name}"] = (rounded - exact).item()
        rows.append(row)
    return pd.DataFrame(rows).set_index("width [m]")


def at_the_truth(particles: int) -> pd.DataFrame:
    """Return log-likelihoods of every record by every filter, and of one that needs a memory.

    Released at 2.5 m, the mass of case 1 swings to the other end of the loop, or nearly so. Whether
    it has changed its branch there must be inferred from what follows.
    """
    cases = dict(CASES)
    for name, case in CASES.items():
        if case.memory:
            cases[f"{name}, from {PULLED_OUT} m"] = replace(case, start=PULLED_OUT)
    ensembles = (psf.EnKF(particles), psf.PFEnKF(particles), psf.BootstrapPF(particles))
    rows, point = {}, TRUTH | {"sigma": 0.05}
    for name, case in cases.items():
        # EKF raises an error for a state that is either 1 or -1.
        ekf = np.nan if case.memory else log_likelihoods(case, psf.EKF(), point).item()
        row = rows[name] = {"EKF": ekf}
        for filter in ensembles:
            values = log_likelihoods(case, filter, point, seed=np.arange(N_SEEDS))
            kind = type(filter).__name__
            row |= {kind: values.mean(), f"sd {kind}": values.std(ddof=1)}
    return pd.DataFrame(rows).T.rename_axis("record")


def reweighted(case: Case, tree: xr.DataTree, filter, draws: int, rng) -> xr.DataTree:
    """Compute the posterior by a filter from draws of the nearby posterior by the EKF.

    So many draws, evenly spaced, are weighted by the ratio of the likelihoods (that of the filter
    with seed 0), and each chain is resampled with its own weights: chains that disagree before also
    disagree after. The attribute ``efficiency`` is the effective fraction of the draws; it is near
    zero if the posteriors differ much.
    """
    posterior = tree["posterior"].to_dataset()
    every = max(1, posterior.sizes["chain"] * posterior.sizes["draw"] // draws)
    posterior = posterior.isel(draw=slice(every - 1, None, every)).reset_coords(drop=True)
    values = {name: posterior[name].values for name in TRUTH}
    log_weights = log_likelihoods(case, filter, values) - log_likelihoods(case, psf.EKF(), values)
    weights = np.exp(log_weights - log_weights.max())
    chains = []
    for i, shares in enumerate(weights / weights.sum(axis=1, keepdims=True)):
        # Systematic resampling keeps the order, and with it the similarity of neighbours.
        heights = (np.arange(shares.size) + rng.random()) / shares.size
        picked = np.minimum(np.searchsorted(np.cumsum(shares), heights), shares.size - 1)
        chains.append(posterior.isel(chain=i, draw=picked).drop_vars("draw", errors="ignore"))
    drawn = xr.concat(chains, dim="chain").assign_coords(
        chain=range(len(chains)), draw=range(weights.shape[1])
    )
    found = xr.DataTree.from_dict({"posterior": drawn})
    found.attrs["efficiency"] = weights.sum() ** 2 / np.sum(weights**2) / weights.size
    return found
