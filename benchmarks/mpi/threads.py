"""Cost of an evaluation for the busiest of so many ranks, which are threads of one process."""

import json
import sys
from dataclasses import asdict
from pathlib import Path
from statistics import median

from benchmarks.mpi.cases import SIZES, THREADS, cases, with_exact_kernels
from benchmarks.mpi.watched import Cost, cost

ROUNDS = 5
LONG, FEW = 5.0, (1, 2, 16)  # cases that take this many CPU seconds are measured once, on few sizes


def main(target: str, kernels: str) -> None:
    if kernels == "exact":
        with_exact_kernels()
    found = []
    for case in cases(kernels == "exact"):
        if case.n == min(SIZES):  # compiles, for all sizes
            cost(case, 2, seed=0)
        short = cost(case, 1, seed=0).compute < LONG
        sizes = [r for r in (THREADS if short else FEW) if case.fits(r)]
        costs: dict[int, list[Cost]] = {r: [] for r in sizes}
        for seed in range(ROUNDS if short else 1):
            for r in sizes:
                costs[r].append(cost(case, r, seed))
        row = {"case": asdict(case), "ranks": sizes}
        for name in ("compute", "n_exchanges", "n_bytes"):
            row[name] = [median(getattr(one, name) for one in costs[r]) for r in sizes]
        found.append(row)
        Path(target).write_text(json.dumps(found))
        print(f"{case.name}: " + ", ".join(f"{s:.3g}" for s in row["compute"]), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
