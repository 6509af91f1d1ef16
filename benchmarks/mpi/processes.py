"""Ranks as processes: how they are started, and their output."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from benchmarks.measure import ROOT

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
AS_ROOT = {
    f"{prefix}_ALLOW_RUN_AS_ROOT{suffix}": "1"
    for prefix in ("OMPI", "PRTE")
    for suffix in ("", "_CONFIRM")
}


def launcher() -> str:
    """Return the mpiexec of this environment, or of the system."""
    here = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
    found = shutil.which("mpiexec", path=here)
    if found is None:
        raise SystemExit("no mpiexec: pip install 'pymc-statespace-filters[mpi]'")
    return found


def start(n_ranks: int, module: str, *arguments: str, cache: Path | None = None) -> None:
    """Run a module on so many ranks, or without MPI if 0, and show its output."""
    command = [sys.executable, "-W", "ignore", "-m"]
    if n_ranks > 0:
        command = [launcher(), "-n", str(n_ranks), *command, "mpi4py", "-m"]
    environment = os.environ | ONE_THREAD | AS_ROOT | {"PYTHONPATH": str(ROOT)}
    if cache is not None:
        environment["PYTENSOR_FLAGS"] = f"base_compiledir={cache.as_posix()}"
    subprocess.run([*command, module, *arguments], cwd=ROOT, env=environment, check=True)
