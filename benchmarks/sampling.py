"""Chains on the double well by EKF: draws and effective draws per CPU second.

Every sampler starts at the parameters of the record and runs one chain per seed. Time is counted in
two ways: for all iterations, including tuning, and for the kept draws alone. The effective sample
size is that of the kept draws. A run of one draw measures the time before the first iteration,
which is subtracted. The time after the last one, up to the DataTree, is included.
"""

import logging
import os
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import pymc as pm
from arviz_stats.base import array_stats

import pymc_statespace_filters as psf
from benchmarks.measure import FOLDER, ROOT
from benchmarks.peers.client import ONE_THREAD
from benchmarks.systems import DOUBLE_WELL, DOUBLE_WELL_TRUTH, STEPS, simulated

N_SEEDS, TUNE, DRAWS = 5, 2000, 20_000
NAMES = ("alpha", "beta", "sigma", "gamma")


@dataclass(frozen=True)
class Chains:
    """Results of one sampler per CPU second: medians over the seeds, lowest and highest.

    The first numbers count the whole run, the last two the kept draws and their time.
    """

    sampler: str
    iterations_per_second: float = np.nan
    ess_per_second: float = np.nan
    ess_low: float = np.nan
    ess_high: float = np.nan
    note: str = ""
    kept_per_second: float = np.nan
    kept_ess_per_second: float = np.nan


def double_well_model(filter, steps=STEPS) -> pm.Model:
    _, observed = simulated(DOUBLE_WELL, DOUBLE_WELL_TRUTH, steps)
    with pm.Model() as model:
        pm.Normal("alpha", 0, 10)
        pm.Normal("beta", 0, 10)
        pm.HalfNormal("sigma", 1)
        pm.HalfNormal("gamma", 1)
        psf.StateSpace("d", DOUBLE_WELL, filter, steps=steps, observed=observed)
    return model


def summarised(sampler: str, chains, seconds, kept_seconds, note: str = "") -> Chains:
    """Chains (seed, draw, parameter), and the CPU seconds of each, whole and of the kept draws."""
    smallest = [min(array_stats.ess(chain[None, :, i]) for i in range(4)) for chain in chains]
    rates = np.array(smallest) / seconds
    speed = np.median((TUNE + DRAWS) / np.array(seconds))
    return Chains(
        sampler,
        speed,
        np.median(rates),
        rates.min(),
        rates.max(),
        note,
        kept_per_second=np.median(DRAWS / np.array(kept_seconds)),
        kept_ess_per_second=np.median(np.array(smallest) / kept_seconds),
    )


def by_pymc(sampler: str, step: Callable) -> Chains:
    """Run chains of ``pm.sample`` with a step method."""
    quiet = {"quiet": True, "compute_convergence_checks": False, "cores": 1}
    return of_runs(sampler, lambda **run: pm.sample(step=step(), **quiet, **run))


def of_runs(sampler: str, sample: Callable) -> Chains:
    """Run chains of a function with the arguments of ``pm.sample``.

    A second run of the same seed that stops after tuning gives the time of the kept draws.
    """

    def run(seed, tune, draws):
        start = time.process_time()
        idata = sample(
            draws=draws,
            tune=tune,
            chains=1,
            initvals=DOUBLE_WELL_TRUTH,
            random_seed=seed,
            progressbar=False,
        )
        seconds = time.process_time() - start
        return np.stack([idata.posterior[name].values[0] for name in NAMES], axis=1), seconds

    logging.getLogger("pymc").setLevel(logging.ERROR)  # of much too short chains
    with double_well_model(psf.EKF()):
        run(0, 1, 1)
        before = np.median([run(0, 1, 1)[1] for _ in range(5)])
        pairs = [(run(s, TUNE, DRAWS), run(s, TUNE, 1)) for s in range(N_SEEDS)]
    chains, seconds = zip(*(whole for whole, _ in pairs), strict=True)
    kept = [whole[1] - tuning[1] for whole, tuning in pairs]
    return summarised(sampler, chains, np.array(seconds) - before, kept)


def by_pymcmcstat() -> Chains:
    sampler, target = "pymcmcstat", FOLDER / "pymcmcstat.npz"
    python = ROOT / ".venv-bench" / "bin" / "python"
    if not python.exists():
        return Chains(sampler, note="no environment .venv-bench")
    numbers = map(str, (N_SEEDS, TUNE, DRAWS))
    command = [python, "-W", "ignore", "-m", "benchmarks.peers.pymcmcstat_dram"]
    done = subprocess.run(
        [*command, FOLDER / "records.npz", target, *numbers],
        cwd=ROOT,
        env=os.environ | ONE_THREAD | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        return Chains(sampler, note=done.stderr.strip().split("\n")[-1][:200])
    result = np.load(target)
    return summarised(
        f"pymcmcstat {result['version']}",
        result["chains"],
        result["seconds"],
        result["seconds"] * DRAWS / (TUNE + DRAWS),
        "adapts to the end; on the numba loop by hand, with names put back that SciPy dropped",
    )


def sampling() -> list[Chains]:
    return [
        of_runs("psf.sample_dram()", psf.sample_dram),
        of_runs(
            "psf.sample_dram(), one stage",
            partial(psf.sample_dram, kernel={"stages": 1}),
        ),
        by_pymc("pm.sample(step=psf.DRAM())", psf.DRAM),
        by_pymc("pm.sample(step=psf.DRAM(stages=1))", lambda: psf.DRAM(stages=1)),
        by_pymc("pm.sample(step=pm.DEMetropolisZ())", pm.DEMetropolisZ),
        by_pymcmcstat(),
    ]
