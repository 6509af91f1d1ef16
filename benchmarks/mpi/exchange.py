"""Cost of an exchange between two ranks of one machine: run on two ranks.

It measures an exchange from machine code, through the callback, as in a filter, and the bare call
of mpi4py, with the other rank and alone; their difference is one message.
"""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mpi4py import MPI

from benchmarks.mpi.watched import many_exchanges
from pymc_statespace_filters.filters.ensemble.reductions import RankLayout
from pymc_statespace_filters.parallel.communicator import communicator_of

ROWS, COLUMNS = 4, (2, 16, 157, 1563, 10_000, 100_000)  # as in the filters
ROUNDS = 300  # short ones: some run without interference


def seconds(work: Callable[[int], object], n: int) -> float:
    """Return the seconds of one of n calls in the fastest round: other load only slows it down."""
    rounds = []
    for _ in range(ROUNDS):
        MPI.COMM_WORLD.Barrier()
        start = time.perf_counter()
        work(n)
        rounds.append((time.perf_counter() - start) / n)
    return min(rounds)


def bare(comm: MPI.Comm, array: np.ndarray) -> Callable[[int], None]:
    counts = [array.size // comm.size] * comm.size

    def work(n: int) -> None:
        for _ in range(n):
            comm.Allgatherv(MPI.IN_PLACE, [array, (counts, None), MPI.DOUBLE])

    return work


def main(target: str) -> None:
    ranks = communicator_of("world")
    share = RankLayout(ranks.rank, ranks.size, ranks.exchange)
    many_exchanges(share, np.zeros((ROWS, 2)), 1)
    found = {"n_bytes": [8 * ROWS * columns for columns in COLUMNS], "callback": []}
    for columns in COLUMNS:
        array = np.zeros((ROWS, columns))
        n = max(2, min(50, 100_000 // columns))
        found["callback"].append(seconds(lambda n, a=array: many_exchanges(share, a, n), n))
    small = np.zeros(2)
    found["bare"] = seconds(bare(MPI.COMM_WORLD, small), 50)
    found["alone"] = seconds(bare(MPI.COMM_SELF, small), 50)
    if ranks.rank == 0:
        Path(target).write_text(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1])
