"""NUTS on a panel of 100 records: as one variable, as a loop of variables, and by dynestyx.

Records of the double well, 50 observations each, with a linear stiffness of their own from a
population; the likelihood is that of the EKF. All make a chain of as many tuning iterations as
draws, on one core. Seconds are those of tuning and draws, and of the whole call with compilation.
"""

import logging
import time
from dataclasses import dataclass

import arviz as az
import numpy as np
import pymc as pm

import pymc_statespace_filters as psf
from benchmarks.measure import FOLDER, Peers
from benchmarks.peers.client import PeerError
from benchmarks.systems import DOUBLE_WELL, DOUBLE_WELL_TRUTH

N_RECORDS, STEPS = 100, np.arange(0, 1000, 20)
DRAWS = 400
ROUNDS = 3  # of ours, in turn; the median is kept


@dataclass(frozen=True)
class PanelNuts:
    """One line: effective draws of a typical record's parameter, and seconds."""

    who: str
    log_likelihood: float | None  # with the stiffness 4 in all records
    effective: float | None
    seconds: float | None
    whole_call: float | None
    note: str = ""


def records() -> np.ndarray:
    """Observations (records, rows, 1)."""
    stiffness = np.random.default_rng(1).normal(4.0, 0.5, N_RECORDS)
    runs = [
        psf.simulate(DOUBLE_WELL, DOUBLE_WELL_TRUTH | {"alpha": a}, steps=STEPS, random_seed=i)
        for i, a in enumerate(stiffness)
    ]
    return np.array([run["observations"].values for run in runs])


def model_of(observed: np.ndarray, as_panel: bool) -> pm.Model:
    with pm.Model() as model:
        mu = pm.Normal("mu", 4, 2)
        tau = pm.HalfNormal("tau", 1)
        alpha = pm.Normal("alpha", mu, tau, shape=N_RECORDS)
        if as_panel:
            psf.StateSpace(
                "d",
                DOUBLE_WELL,
                psf.EKF(),
                panel=np.repeat(np.arange(N_RECORDS), STEPS.size),
                steps=np.tile(STEPS, N_RECORDS),
                observed=observed.reshape(-1, 1),
                params=DOUBLE_WELL_TRUTH | {"alpha": alpha},
            )
        else:
            for i, record in enumerate(observed):
                psf.StateSpace(
                    f"d{i}",
                    DOUBLE_WELL,
                    psf.EKF(),
                    steps=STEPS,
                    observed=record,
                    params=DOUBLE_WELL_TRUTH | {"alpha": alpha[i]},
                )
    return model


def ours(who: str, observed: np.ndarray, as_panel: bool) -> PanelNuts:
    began = time.perf_counter()
    with model_of(observed, as_panel):
        idata = pm.sample(
            DRAWS,
            tune=DRAWS,
            chains=1,
            cores=1,
            random_seed=1,
            progressbar=False,
            compute_convergence_checks=False,
        )
    whole = time.perf_counter() - began
    each = [
        psf.log_likelihood(DOUBLE_WELL, psf.EKF(), DOUBLE_WELL_TRUTH, record, steps=STEPS).sum()
        for record in observed
    ]
    effective = float(np.median(az.ess(idata, var_names="alpha")["alpha"]))
    seconds = idata["posterior"].attrs["sampling_time"]
    return PanelNuts(who, float(np.sum(each)), effective, seconds, whole)


def theirs(peers: Peers) -> PanelNuts:
    try:
        task = peers.task("dynestyx_panel", f"nuts/{DRAWS}")
        task.peer.ask("prepare", "log_likelihood")
        value = task.peer.ask("values", "log_likelihood", 1)["values"][0]
        first = task.peer.ask("prepare", task.task)["first"]
        effective = task.peer.ask("values", task.task, 1)["values"][0]
        seconds = task.peer.ask("time", task.task)["seconds"]
    except PeerError as reason:
        return PanelNuts("dynestyx", None, None, None, None, str(reason))
    return PanelNuts("dynestyx", value, effective, seconds, first)


def panel_nuts(peers: Peers) -> list[PanelNuts]:
    logging.getLogger("pymc").setLevel(logging.CRITICAL)
    observed = records()
    stored = dict(np.load(FOLDER / "records.npz"))
    np.savez(FOLDER / "records.npz", **stored | {"panel": observed})
    for as_panel in (True, False):  # fills the caches on disk
        model_of(observed, as_panel).compile_dlogp()
    kinds = {"ours, a panel": True, "ours, a loop of variables": False}
    runs = [ours(who, observed, as_panel) for _ in range(ROUNDS) for who, as_panel in kinds.items()]
    medians = [
        sorted((run for run in runs if run.who == who), key=lambda run: run.seconds)[ROUNDS // 2]
        for who in kinds
    ]
    return [*medians, theirs(peers)]
