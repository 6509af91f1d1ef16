"""Effective draws per evaluation and per CPU second: samplers with default starts and adaptation.

Effective draws are the smallest bulk effective sample size of all parameters. They are divided by
all evaluations of the likelihood and all CPU seconds, starts and tuning included, and by those of
the kept draws alone. A gradient counts as one evaluation. Compilation is left out.

``python -m benchmarks.efficiency --before CHECKOUT`` measures all runs, also of another version of
this package, and writes the tables of ``docs/reference/benchmarks.md``. Runs are stored in
``out/benchmarks/efficiency.jsonl``, and a later call makes only those that are missing. ``--only``
and ``--samplers`` choose runs by the beginnings of names. Peers must be importable in this
environment: ``pip install nutpie emcee pymcmcstat``; rows of missing ones are left out.
"""

import argparse
import json
import logging
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "agg"}

import numpy as np
import pymc as pm
from arviz_stats.base import array_stats

from benchmarks import efficiency_samplers as samplers
from benchmarks.measure import FOLDER, ROOT
from benchmarks.posteriors import POSTERIORS

STORE = FOLDER / "efficiency.jsonl"
BEFORE, N_SEEDS = "the version before", 5
SLOW, NOISY = "GridFilter", "BootstrapPF"
SLOW_DRAWS, SLOW_SEEDS = 1000, 2


class Plan(NamedTuple):
    sampler: Callable[[pm.Model], samplers.Sampler]
    draws: int = 3000
    tune: int = 1000
    seeds: int = N_SEEDS


LONG = "psf.sample_dram(10_000)"
PLANS = {
    "psf.sample_dram()": Plan(samplers.dram),
    "psf.sample_dram(tune=3000)": Plan(samplers.dram, tune=3000),
    BEFORE: Plan(samplers.dram),
    f"{BEFORE}, tune=3000": Plan(samplers.dram, tune=3000),
    "pm.DEMetropolisZ()": Plan(samplers.de_metropolis),
    "nutpie": Plan(samplers.by_nutpie),
    "pymcmcstat": Plan(samplers.by_pymcmcstat),
    "emcee": Plan(samplers.by_emcee),
    LONG: Plan(samplers.dram, draws=10_000, seeds=2),
}


@dataclass(frozen=True)
class Run:
    """A run, its smallest effective sample size and largest R-hat, and its cost."""

    posterior: str
    sampler: str
    seed: int
    draws: int
    tune: int
    ess: float
    rhat: float
    evaluations: int
    kept_evaluations: int
    seconds: float
    start_seconds: float
    start_evaluations: int
    kept_seconds: float


def banana() -> pm.Model:
    """The four-dimensional banana of ``tests/evidence/targets.py``."""
    with pm.Model() as model:
        x = pm.Normal("x", 0.0, [1.0, 3.0, 3.0, 3.0])
        mean = pm.math.stack([x[1] + x[0] ** 2, x[2], x[3]])
        pm.Potential("y", pm.logp(pm.Normal.dist(mean, 0.4), np.array([0.5, -2.0, 2.0])).sum())
    return model


def normal(dim: int = 10, correlation: float = 0.7) -> pm.Model:
    """Normals of standard deviations 1 to 10, each correlated with the next."""
    index = np.arange(dim)
    sd = 1.0 + index
    cov = np.outer(sd, sd) * correlation ** np.abs(index[:, None] - index)
    with pm.Model() as model:
        pm.MvNormal("x", np.zeros(dim), cov=cov)
    return model


TARGETS = POSTERIORS | {"banana, 4": banana, "normal, 10": normal}


def planned(posterior: str, name: str) -> Plan | None:
    """The plan of a row: shorter for slow filters, None if the sampler does not suit the filter."""
    plan = PLANS[name]
    if NOISY in posterior:
        # Its likelihood is an estimate with new noise at every call.
        return plan._replace(seeds=SLOW_SEEDS) if plan.sampler is samplers.dram else None
    if SLOW in posterior:
        # It has no gradient.
        short = plan._replace(draws=SLOW_DRAWS, seeds=SLOW_SEEDS)
        return short if plan.sampler is not samplers.by_nutpie else None
    return plan


def measured(posterior: str, name: str, plan: Plan, seeds: list[int], model: pm.Model) -> None:
    """Make the runs of a row, and store each."""
    sample = plan.sampler(model)
    for seed in seeds:
        run = sample(seed, plan.draws, plan.tune)
        columns = np.moveaxis(run.draws, 2, 0)
        row = Run(
            posterior, name, seed, plan.draws, plan.tune,
            float(min(array_stats.ess(c) for c in columns)),
            float(max(array_stats.rhat(c) for c in columns)),
            run.evaluations, run.kept_evaluations, run.seconds, run.start_seconds,
            run.start_evaluations, run.kept_seconds,
        )  # fmt: skip
        with STORE.open("a") as file:
            print(json.dumps(asdict(row), default=float), file=file)
        print(
            f"{posterior:30} {name:30} {seed} ess {row.ess:6.0f} rhat {row.rhat:.3f} "
            f"{row.evaluations} calls {row.seconds:.1f} s",
            flush=True,
        )


def stored() -> list[Run]:
    lines = STORE.read_text().splitlines() if STORE.exists() else []
    return [Run(**json.loads(line)) for line in lines]


def measure_all(only: list[str], names: list[str], n_seeds: int) -> None:
    """Make the chosen runs that are not stored."""
    done = {(run.posterior, run.sampler, run.seed) for run in stored()}
    for posterior in only:
        model = None
        for name in names:
            plan = planned(posterior, name)
            if plan is None:
                continue
            seeds = range(min(n_seeds, plan.seeds))
            missing = [seed for seed in seeds if (posterior, name, seed) not in done]
            if missing:
                model = model or TARGETS[posterior]()
                try:
                    measured(posterior, name, plan, missing, model)
                except ImportError as reason:
                    print(f"{name}: {reason}", flush=True)


def by_version(checkout: Path, arguments: list[str]) -> None:
    """The same with the package of a checkout, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        for name, origin in (("pymc_statespace_filters", checkout.resolve()), ("benchmarks", ROOT)):
            Path(folder, name).symlink_to(origin / name)
        for name in ("out", "docs"):
            Path(folder, name).symlink_to(ROOT / name)
        command = [sys.executable, "-m", "benchmarks.efficiency", "--samplers", BEFORE, *arguments]
        path = os.pathsep.join([folder, os.environ.get("PYTHONPATH", "")])
        subprocess.run(command, cwd=folder, env=os.environ | {"PYTHONPATH": path}, check=True)


def beginning(options: list[str] | None, names: list[str]) -> list[str]:
    return [n for n in names if options is None or any(n.startswith(o) for o in options)]


def main() -> None:
    from benchmarks.efficiency_tables import write

    parser = argparse.ArgumentParser(prog="python -m benchmarks.efficiency", description=__doc__)
    parser.add_argument("--only", nargs="+", help="posteriors")
    parser.add_argument("--samplers", nargs="+")
    parser.add_argument("--seeds", type=int, default=N_SEEDS)
    parser.add_argument("--before", type=Path, help="a checkout of another version")
    parser.add_argument("--report", action="store_true", help="measure nothing")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    logging.disable(logging.ERROR)  # of short chains
    FOLDER.mkdir(parents=True, exist_ok=True)
    only = beginning(options.only, list(TARGETS))
    names = beginning(options.samplers, list(PLANS))
    if options.samplers is None:
        names = [name for name in names if not name.startswith(BEFORE)]
    if not options.report:
        if options.before is not None:
            by_version(options.before, ["--seeds", str(options.seeds), "--only", *only])
        measure_all(only, names, options.seeds)
    sys.stdout.write(write(stored(), list(TARGETS), list(PLANS), LONG))


if __name__ == "__main__":
    main()
