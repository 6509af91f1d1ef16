"""A whole study on one rank and on two: three rivals with four chains each, by ``run_models``.

Without arguments, it makes every run in turn, each in its own processes; with them, one such run.
"""

import json
import logging
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pymc as pm

import pymc_statespace_filters as psf
from benchmarks.mpi.processes import start
from benchmarks.systems import STEPS

ROUNDS = 5
CHAINS, TUNE, DRAWS = 4, 500, 500
RIVALS = {"M1": ("alpha",), "M2": ("alpha", "beta"), "M3": ("alpha", "beta", "gamma")}
GROUPS = "warmup_sample_stats", "sample_stats"
MODULE = "benchmarks.mpi.study"


def drift(x, alpha, beta=0.0, gamma=0.0):
    return [alpha * x[0] + beta * x[0] ** 3 + gamma * x[0] ** 5]


SYSTEM = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(drift, lambda sigma_m: [[0.6, sigma_m]], dt=0.01),
    observation=lambda x: [x[0]],
    observation_noise=[[0.08]],
    initial_mean=[1.0],
    initial_cov=[[0.5]],
)


def models() -> dict[str, pm.Model]:
    truth = {"alpha": 4.0, "beta": -4.0, "sigma_m": 0.1}
    record = psf.simulate(SYSTEM, truth, steps=STEPS, random_seed=2)
    return {name: rival(coefficients, record) for name, coefficients in RIVALS.items()}


def rival(coefficients: tuple[str, ...], record) -> pm.Model:
    with pm.Model() as model:
        for name in coefficients:
            pm.Normal(name, 0, 5)
        pm.HalfNormal("sigma_m", 1)
        observed = record["observations"]
        psf.StateSpace("d", SYSTEM, psf.BootstrapPF(100), steps=STEPS, observed=observed)
    return model


def cpu_seconds() -> float:
    """CPU seconds of this process, including system calls."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def timed(rivals: dict[str, pm.Model], tune: int, draws: int) -> tuple[float, float, dict | None]:
    """Return wall and CPU seconds of a run on this rank, and its result."""
    wall, cpu = time.perf_counter(), cpu_seconds()
    found = psf.run_models(
        rivals,
        sampler="dram",
        draws=draws,
        tune=tune,
        chains=CHAINS,
        cores=1,
        comm="world",
        random_seed=1,
        discard_tuned_samples=False,
        progressbar=False,
    )
    return time.perf_counter() - wall, cpu_seconds() - cpu, found


def run(target: str) -> None:
    """Run one study on the ranks that mpiexec started."""
    from mpi4py import MPI

    logging.getLogger("pymc").setLevel(logging.CRITICAL)  # of much too short chains
    rivals = models()
    before, cpu_before, _ = timed(rivals, 1, 1)
    MPI.COMM_WORLD.Barrier()
    wall, cpu, found = timed(rivals, TUNE, DRAWS)
    cpus = MPI.COMM_WORLD.gather(cpu - cpu_before)
    if found is None:
        return
    evaluations = {
        name: sum(idata[group]["n_evaluations"].sum("draw").values for group in GROUPS).tolist()
        for name, idata in found.items()
    }
    draws = [idata["posterior"].to_dataset().to_array().values for idata in found.values()]
    row = {"before": before, "wall": wall, "cpu": cpus, "evaluations": evaluations}
    row["digest"] = float(sum(np.sum(values) for values in draws))
    Path(target).write_text(json.dumps(row))


def one(n_ranks: int, module: str = MODULE) -> dict:
    """Make one run in its own processes; ``process_cpu`` and ``process_wall`` are theirs, whole."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "run.json"
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        begin = time.perf_counter()
        start(n_ranks, module, str(target), "run")
        now = resource.getrusage(resource.RUSAGE_CHILDREN)
        row = json.loads(target.read_text())
    row["process_wall"] = time.perf_counter() - begin
    row["process_cpu"] = now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime
    return row


def measure(target: str) -> None:
    runs: dict[str, list[dict]] = {"1": [], "2": []}
    one(1)  # compiles
    for _ in range(ROUNDS):
        for n_ranks, rows in runs.items():
            rows.append(one(int(n_ranks)))
            last = rows[-1]
            print(f"{n_ranks}: {last['wall']:.1f} s, CPU {sum(last['cpu']):.1f} s", flush=True)
        if len({row["digest"] for rows in runs.values() for row in rows}) > 1:
            raise RuntimeError("one rank and two do not draw the same")
        Path(target).write_text(json.dumps({"runs": runs}))


if __name__ == "__main__":
    run(sys.argv[1]) if sys.argv[2:] == ["run"] else measure(sys.argv[1])
