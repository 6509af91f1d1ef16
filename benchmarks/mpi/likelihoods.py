"""One likelihood on one and on two processes in turn: run on two ranks.

While one rank evaluates alone, the other sleeps.
"""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

from mpi4py import MPI

from benchmarks.mpi.cases import Case, cases, evaluation, with_exact_kernels
from benchmarks.mpi.watched import Watched
from pymc_statespace_filters.parallel.communicator import communicator_of

SECONDS, MOST, LEAST = 40.0, 15, 5  # per case; at most and at least so many rounds


@dataclass(frozen=True)
class Wall:
    """Wall seconds of an evaluation, and its exchanges: medians of rounds in turn."""

    case: Case
    one: list[float]
    two: list[float]
    in_exchanges: list[float]

    def median(self, n_ranks: int) -> float:
        """Scaled to the whole record."""
        return self.case.scale * median(self.one if n_ranks == 1 else self.two)

    @classmethod
    def of_json(cls, row: dict) -> "Wall":
        return cls(**(row | {"case": Case(**row["case"])}))


def taken(evaluate: Callable[[int], float], seed: int) -> float:
    start = time.perf_counter()
    evaluate(seed)
    return time.perf_counter() - start


def wait_politely(comm: MPI.Comm) -> None:
    """Wait at a barrier without taking a core from a rank that still works."""
    request = comm.Ibarrier()
    while not request.Test():
        time.sleep(1e-3)


def measure(case: Case) -> Wall:
    comm, both = MPI.COMM_WORLD, Watched(communicator_of("world"), time.perf_counter)
    alone, run_collectively = evaluation(case, communicator_of(None)), evaluation(case, both)
    found = Wall(case, [], [], [])
    if comm.rank == 0:
        alone(0)
    wait_politely(comm)
    run_collectively(0)
    seed, rounds = 0, MOST
    while seed < rounds:
        seed += 1
        if comm.rank == 0:
            found.one.append(taken(alone, seed))
        wait_politely(comm)
        both.forget()
        comm.Barrier()
        found.two.append(taken(run_collectively, seed))
        found.in_exchanges.append(both.seconds)
        each = comm.bcast(median(found.one) + median(found.two) if comm.rank == 0 else None)
        rounds = max(LEAST, min(MOST, int(SECONDS / each)))
    return found


def main(target: str, kernels: str) -> None:
    if kernels == "exact":
        with_exact_kernels()
    found = []
    for case in cases(kernels == "exact"):
        found.append(measure(case))
        if MPI.COMM_WORLD.rank == 0:
            last = found[-1]
            print(f"{case.name}: {median(last.one):.4g} s, {median(last.two):.4g} s", flush=True)
    if MPI.COMM_WORLD.rank == 0:
        Path(target).write_text(json.dumps([asdict(wall) for wall in found]))


if __name__ == "__main__":
    main(*sys.argv[1:])
