"""Time and memory of gathering draws on rank 0: run on two ranks, and on one.

Four chains of 100,000 draws of five parameters, with a density that costs almost nothing.
"""

import json
import logging
import sys
import time
from pathlib import Path
from statistics import median

import pymc as pm
from mpi4py import MPI
from xarray import DataTree

import pymc_statespace_filters as psf
from pymc_statespace_filters.parallel.communicator import Communicator

CHAINS, DRAWS, N = 4, 100_000, 5
ROUNDS = 5
MEGABYTE = 2**20


class Clock:
    """Seconds that a rank spends in some methods of `Communicator`."""

    def __init__(self, names: tuple[str, ...]):
        self.seconds = 0.0
        for name in names:
            setattr(Communicator, name, self.around(getattr(Communicator, name)))

    def around(self, method):
        def timed(*arguments):
            start = time.perf_counter()
            try:
                return method(*arguments)
            finally:
                self.seconds += time.perf_counter() - start

        return timed


def memory(what: str) -> float:
    """Return VmRSS, or VmHWM, its peak since the last reset, in megabytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(what)) / 1024


def forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def size(tree: DataTree) -> float:
    return sum(node.to_dataset().nbytes for node in tree.subtree) / MEGABYTE


def main(target: str) -> None:
    logging.getLogger("pymc").setLevel(logging.CRITICAL)  # of much too short chains
    clock = Clock(("receive", "receive_arrays"))
    with pm.Model() as model:
        pm.Normal("x", 0, 1, shape=N)

    def sample(draws: int):
        start = time.perf_counter()
        clock.seconds = 0.0
        settings = {"tune": 200, "chains": CHAINS, "cores": 1, "random_seed": 1, "model": model}
        idata = psf.sample_dram(draws, comm="world", progressbar=False, **settings)
        return idata, time.perf_counter() - start

    sample(10)
    found: dict[str, list[float]] = {"received": [], "wall": []}
    for i in range(ROUNDS):
        MPI.COMM_WORLD.Barrier()
        baseline = memory("VmRSS")
        forget_peak()
        idata, wall = sample(DRAWS)
        if idata is not None:
            found["wall"].append(wall)
            found["received"].append(clock.seconds)
            if i == 0:  # later runs reuse memory that the first one returned to Python only
                found |= {"peak": [memory("VmHWM") - baseline], "result": [size(idata)]}
    if MPI.COMM_WORLD.rank == 0:
        Path(target).write_text(json.dumps(found))
        print({name: median(values) for name, values in found.items()}, flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
