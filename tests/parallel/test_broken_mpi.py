"""A computer whose MPI library cannot be loaded: nothing is said until ``comm=`` asks for it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.waiting import LIMIT

ROOT = Path(__file__).parents[2]
SCRIPT = """
import os, sys
import numpy as np
import pymc as pm
import pytensor
import pymc_statespace_filters as psf
from tests.modes import AS_IT_STANDS
from tests.systems import FREE

pytensor.config.mode = AS_IT_STANDS
record = {"steps": range(1, 21), "observed": np.sin(np.arange(20.0))}
with pm.Model():
    pm.Uniform("a", 0.0, 1.0)
    psf.StateSpace("d", FREE, psf.EKF(), **record)
    run = dict(chains=2, initvals={"a": 0.5}, random_seed=1)
    run |= dict(progressbar=False, compute_convergence_checks=False)
    for comm in (None, "world"):  # without a launcher the world is this process
        idata = psf.sample_dram(5, tune=5, comm=comm, **run)
    print(dict(idata["posterior"].sizes), "mpi4py" in sys.modules)
    os.environ["PMIX_RANK"] = "0"  # as if mpiexec had started it
    psf.sample_dram(5, tune=5, comm="world", **run)
"""
NO_LIBRARY = {"MPI4PY_LIBMPI": "/nowhere/libmpi.so", "MPI4PY_MPIABI": "none"}
STUB = "raise RuntimeError('cannot load MPI library')"


@pytest.mark.parametrize("broken", ["library", pytest.param("module", marks=pytest.mark.slow)])
def test_only_comm_needs_mpi(tmp_path, broken):
    """The real mpi4py without its library, and a stand-in that raises wherever it is imported."""
    path = [str(ROOT)]
    if broken == "module":
        (tmp_path / "mpi4py.py").write_text(STUB)
        path.insert(0, str(tmp_path))
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_", "PMI"))}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", SCRIPT],
        env=environment | NO_LIBRARY | {"PYTHONPATH": os.pathsep.join(path)},
        capture_output=True,
        timeout=LIMIT,
        encoding="utf-8",
        check=False,
    )
    assert done.stdout == "{'chain': 2, 'draw': 5} False\n", done.stderr
    assert done.returncode == 1
    # Nothing before the traceback, whose last line has the error and its cure.
    assert done.stderr.startswith("Traceback (most recent call last):")
    last = done.stderr.splitlines()[-1]
    assert "ParallelError: mpi4py finds no MPI library (" in last
    assert "pip install 'pymc-statespace-filters[mpi]'" in last
