"""Cost of a compiled chain apart from its likelihood, gain from threads, cost of checkpoints.

The overhead is measured on a model whose density costs almost nothing, four normals. It is the time
of the chains, from the random numbers to the DataTree, less that of the same number of evaluations
in machine code. Threads and checkpoints are measured in wall time, with the runs in turn.
"""

import logging
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from statistics import median

import numpy as np
import pymc as pm
from numba import njit

import pymc_statespace_filters as psf
from benchmarks.sampling import double_well_model
from benchmarks.systems import DOUBLE_WELL_TRUTH
from benchmarks.timing import Timed
from pymc_statespace_filters.sampling.kernel.transition import evaluate
from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings
from pymc_statespace_filters.sampling.target.target import Target

ROUNDS = 5


@dataclass(frozen=True)
class ChainCost:
    """One line: what was measured, the figure with its unit, how."""

    what: str
    figure: str
    note: str


@njit(nogil=True)
def evaluations(density, n):
    total = 0.0
    for i in range(n):
        density.position[0] = 1e-9 * i
        total += evaluate(density).log_density
    return total


def four_normals() -> pm.Model:
    with pm.Model() as model:
        pm.Normal("x", 0, 1, shape=4)
    return model


def first_draws() -> Timed:
    """The shortest chain on four normals, as a task whose first call compiles."""
    run = partial(psf.sample_dram, 4, 4, chains=1, progressbar=False, model=four_normals())
    return Timed(lambda seed: float(run(random_seed=seed)["posterior"]["x"][0, -1, 0]))


def microseconds_a_draw(tune: bool, n: int = 200_000) -> float:
    """Return the time of a one-stage chain, warm-up or draws, apart from its evaluations."""
    model = four_normals()
    run = partial(
        psf.sample_dram,
        chains=1,
        cores=1,
        kernel={"stages": 1},
        random_seed=1,
        progressbar=False,
        model=model,
    )
    target = Target(model, None, RandomWalkSettings())
    target.prepare()
    bound = target.density.bind()
    long = {"tune": n, "draws": 1} if tune else {"tune": 1, "draws": n}
    nothing = {"tune": 1, "draws": 1}

    def taken(work: Callable[[], object]) -> float:
        start = time.process_time()
        work()
        return time.process_time() - start

    run(**nothing), evaluations(bound.native, 1)
    rounds = [
        taken(lambda: run(**long))
        - taken(lambda: run(**nothing))
        - taken(lambda: evaluations(bound.native, n))
        for _ in range(ROUNDS)
    ]
    return 1e6 * median(rounds) / n


def walls(runs: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Return median wall seconds of each, run in turn, once warm."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for name in runs:
        runs[name]()
    for _ in range(ROUNDS):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            times[name].append(time.perf_counter() - start)
    return {name: median(seconds) for name, seconds in times.items()}


def two_chains(model: pm.Model, **settings) -> Callable:
    """Return a function that runs two chains from the truth for a given number of draws."""
    return partial(
        psf.sample_dram,
        tune=0,
        chains=2,
        model=model,
        initvals=DOUBLE_WELL_TRUTH,
        random_seed=1,
        progressbar=False,
        **settings,
    )


def threads(what: str, model: pm.Model, draws: int) -> ChainCost:
    """Compare two chains in two threads with the same chains one after the other."""
    run = two_chains(model)
    taken = walls(
        {
            "before": lambda: run(1, cores=1),
            "one": lambda: run(draws, cores=1),
            "two": lambda: run(draws, cores=2),
        }
    )
    gain = (taken["one"] - taken["before"]) / (taken["two"] - taken["before"])
    each = (taken["one"] - taken["before"]) / (2 * draws)
    return ChainCost(
        f"two threads / one, {what}", f"{gain:.2f} x", f"draws of {1e6 * each:.0f} µs, wall time"
    )


def checkpoints(seconds: float = 16.0) -> ChainCost:
    """Compare chains of some seconds with a checkpoint every five seconds and without."""
    model = double_well_model(psf.EKF())
    run = two_chains(model, cores=2)
    start = time.perf_counter()
    run(20_000)
    draws = int(20_000 * seconds / (time.perf_counter() - start))

    def kept() -> float:
        with tempfile.TemporaryDirectory() as folder:
            start = time.process_time()
            run(draws, checkpoint=os.path.join(folder, "run"))
            return time.process_time() - start

    def not_kept() -> float:
        start = time.process_time()
        run(draws)
        return time.process_time() - start

    ratios = [kept() / not_kept() for _ in range(3)]
    return ChainCost(
        "checkpoint every 5 s / none",
        f"{100 * (median(ratios) - 1):+.1f} %",
        f"CPU time of two chains of {draws} draws by EKF; range "
        f"{100 * (min(ratios) - 1):+.1f} to {100 * (max(ratios) - 1):+.1f} %",
    )


def chains() -> list[ChainCost]:
    logging.getLogger("pymc").setLevel(logging.ERROR)  # of much too short chains
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    four = "one chain, four parameters, one stage; from the random numbers to the DataTree"
    found = [
        ChainCost("overhead of a draw", f"{microseconds_a_draw(tune=False):.2f} µs", four),
        ChainCost(
            "overhead of an iteration of warm-up", f"{microseconds_a_draw(tune=True):.2f} µs", ""
        ),
    ]
    if cores is None or (os.cpu_count() or 1) < 2:
        return found
    # Everything else is measured on one core.
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    try:
        found += [
            threads(
                "EKF, 20,000 steps", double_well_model(psf.EKF(), np.arange(0, 20001, 20)), 8000
            ),
            threads("EnKF(100)", double_well_model(psf.EnKF(100)), 1500),
            checkpoints(),
        ]
    finally:
        os.sched_setaffinity(0, cores)
    return found
