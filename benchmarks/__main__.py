"""Measure everything and write the tables and figures of ``docs/reference/benchmarks.md``.

``python -m benchmarks`` measures part after part and stores each as a file in ``out/benchmarks``.
``--only ekf enkf`` measures some parts again, ``--resume`` those that are missing, and ``--report``
writes the documentation from the stored parts. ``--only normals noise cold demo panel_sampling``
needs no other package; these parts share a file of their own, and the tables of the others stay as
they are. ``ode``, ``epidemic``, ``panel``, ``panel_nuts`` and ``panel_evidence`` have a file each.
"""

import argparse
import json
import os
import subprocess
import sys
import time
import warnings
from dataclasses import asdict
from importlib.metadata import version

os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}

from benchmarks import (
    cold,
    demo,
    growth,
    integrators,
    likelihoods,
    noise,
    ode,
    panel,
    panel_evidence,
    panel_nuts,
    panel_sampling,
    report,
    sampling,
)
from benchmarks.chains import chains
from benchmarks.cpp import compiler
from benchmarks.measure import FOLDER, ROOT, Peers
from benchmarks.systems import write_records

PARTS = {
    "ekf": likelihoods.ekf,
    "linear": likelihoods.linear,
    "enkf": likelihoods.enkf,
    "bootstrap": likelihoods.bootstrap,
    "pf_enkf": likelihoods.pf_enkf,
    "grid": likelihoods.grid,
    "ode": ode.ode,
    "epidemic": likelihoods.epidemic,
    "panel": panel.panel,
    "sampling": lambda peers: sampling.sampling() + chains(),
    "particles": lambda peers: growth.with_particles(),
    "steps": lambda peers: growth.with_steps(),
    "states": lambda peers: growth.with_states(),
    "normals": lambda peers: noise.normals(),
    "noise": lambda peers: noise.noise(),
    "cold": lambda peers: cold.cold(),
    "demo": lambda peers: demo.demo(),
    "panel_evidence": lambda peers: panel_evidence.panel_evidence(),
    "panel_nuts": panel_nuts.panel_nuts,
    "panel_sampling": lambda peers: panel_sampling.panel_sampling(),
    "integrators": lambda peers: integrators.integrators(),
}


def on_one_core() -> None:
    """Pin this process and its children to one core, so that CPU time is that of one thread."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def versions(peers: Peers) -> dict[str, str]:
    found = {name: version(name) for name in ("pymc", "pytensor", "numba", "numpy")}
    try:
        says = subprocess.run([compiler(), "--version"], capture_output=True, text=True)
        found["C++ compiler"] = says.stdout.split("\n")[0]
    except NotImplementedError:
        found["C++ compiler"] = "none"
    head = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True
    )
    found["commit"] = head.stdout.strip() or "unknown"
    # The versions of the peers' own PyMC and numba take precedence where the names are the same.
    return {f"{name} (peer)": v for name, v in peers.versions.items()} | found


def measure(part: str) -> None:
    """Measure one part and store it."""
    start, peers = time.perf_counter(), Peers()
    try:
        rows = [asdict(row) for row in PARTS[part](peers)]
        kept = {"versions": versions(peers), "load": os.getloadavg()[0], "rows": rows}
    finally:
        peers.close()
    (FOLDER / f"{part}.json").write_text(json.dumps(kept, indent=1, default=float))
    print(f"{part}: {time.perf_counter() - start:.0f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--resume", action="store_true", help="skip the parts that are there")
    parser.add_argument("--report", action="store_true", help="measure nothing")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    on_one_core()
    if not options.report:
        write_records(FOLDER / "records.npz")
        for part in options.only:
            if not (options.resume and (FOLDER / f"{part}.json").exists()):
                measure(part)
    sys.stdout.write(report.write([part for part in PARTS if (FOLDER / f"{part}.json").exists()]))


if __name__ == "__main__":
    main()
