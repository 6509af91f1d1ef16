"""Savings from a screen: likelihood calls and effective draws, the double well by PF-EnKF.

Each screen runs a few chains from the parameters of the record. All iterations, including warm-up,
count as CPU time and as calls of the likelihood. The time of a run of two iterations, for
compilation and conversion, is subtracted. The effective sample size is the smallest of the four
parameters, of the kept draws. Run it with ``python -m benchmarks.screening`` from the root of the
repository; it takes some twenty minutes and writes the table of
``docs/explanation/noisy-likelihoods.md``.
"""

import logging
import sys
import time
from typing import NamedTuple

import numpy as np
import pymc as pm
from arviz_stats.base import array_stats

import pymc_statespace_filters as psf
from benchmarks.sampling import NAMES, double_well_model
from benchmarks.systems import DOUBLE_WELL_TRUTH

TUNE = 1000
SCREENS = {"`EKF()`": psf.EKF(), "`EnKF(100)`": psf.EnKF(100)}


class Plan(NamedTuple):
    """Numbers of chains and draws, and the powers of their screens."""

    chains: int
    draws: int
    powers: tuple[float, ...]


# By the number of particles.
PLANS = {250: Plan(5, 3000, (1.0, 0.5, 0.25)), 1000: Plan(3, 2000, (1.0, 0.5))}


def timed(model: pm.Model, settings: dict, chains: int, tune: int, draws: int):
    """Chains, and the CPU seconds of all of them."""
    start = time.process_time()
    idata = psf.sample_dram(
        draws,
        tune,
        chains=chains,
        cores=1,
        model=model,
        random_seed=1,
        initvals=DOUBLE_WELL_TRUTH,
        progressbar=False,
        discard_tuned_samples=False,
        **settings,
    )
    return idata, time.process_time() - start


def row(name: str, model: pm.Model, plan: Plan, settings: dict) -> str:
    """Run a screen's chains and return their row of the table."""
    before = min(timed(model, settings, plan.chains, 5, 5)[1] for _ in range(2))
    idata, seconds = timed(model, settings, plan.chains, TUNE, plan.draws)
    seconds -= before
    stats = idata["sample_stats"]
    calls = stats["n_evaluations"].sum() + idata["warmup_sample_stats"]["n_evaluations"].sum()
    draws = [idata["posterior"][name].values for name in NAMES]
    together = min(array_stats.ess(values) for values in draws)
    alone = [min(array_stats.ess(values[[i]]) for values in draws) for i in range(plan.chains)]
    per_second = plan.chains * np.array(alone) / seconds
    called, moved = float(stats["n_evaluations"].mean()), float(stats["accepted"].mean())
    return (
        f"| {name} | {int(calls)} | {called:.0%} | {moved / called:.0%} | "
        f"{1000 * together / int(calls):.1f} | {together / seconds:.2g} "
        f"({per_second.min():.2g} to {per_second.max():.2g}) |"
    )


def main() -> None:
    logging.getLogger("pymc").setLevel(logging.ERROR)
    for n_particles in [int(n) for n in sys.argv[1:]] or PLANS:
        plan, model = PLANS[n_particles], double_well_model(psf.PFEnKF(n_particles))
        print(f"\n`PFEnKF({n_particles})`, {plan.chains} chains of {TUNE} + {plan.draws}\n")
        print("| screen | calls | called | accepted | ESS per 1000 calls | ESS per CPU second |")
        print("| --- " * 6 + "|")
        print(row("none", model, plan, {}), flush=True)
        for name, screen in SCREENS.items():
            for power in plan.powers:
                kernel = {"screen": screen, "screen_power": power}
                settings = {"kernel": kernel}
                print(row(f"{name}, power {power:g}", model, plan, settings), flush=True)


if __name__ == "__main__":
    main()
