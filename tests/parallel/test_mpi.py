"""What a wrong launch is answered, by a stand-in for mpi4py; real launches are in tests/mpi."""

import os
import subprocess
import sys
import warnings
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.parallel import environment
from pymc_statespace_filters.parallel import mpi as mpi_module
from pymc_statespace_filters.parallel.mpi import mpi_communicator
from tests.waiting import LIMIT

LAUNCHERS = (
    "OMPI_COMM_WORLD_SIZE",
    "PMI_SIZE",
    "MV2_COMM_WORLD_SIZE",
    "SLURM_STEP_NUM_TASKS",
    "PMIX_RANK",
)


class Comm:
    """A communicator of so many ranks; none is the null communicator."""

    def __init__(self, size):
        self.size = size

    def __bool__(self):
        return self.size > 0

    def Get_size(self):
        return self.size


class Intracomm(Comm):
    """The kind that is used."""


def stand_in(world=1, threads=3, initialized=True, finalized=False):
    return SimpleNamespace(
        Comm=Comm,
        Intracomm=Intracomm,
        COMM_WORLD=Intracomm(world),
        THREAD_MULTIPLE=3,
        Query_thread=lambda: threads,
        Is_initialized=lambda: initialized,
        Is_finalized=lambda: finalized,
        get_vendor=lambda: ("Open MPI", (5, 0, 11)),
    )


@pytest.fixture(autouse=True)
def alone(monkeypatch):
    """A process that nobody launched, and that has not asked for MPI."""
    for variable in LAUNCHERS:
        monkeypatch.delenv(variable, raising=False)
    for module in ("mpi4py", "mpi4py.MPI", "mpi4py.run"):
        monkeypatch.delitem(sys.modules, module, raising=False)


@pytest.fixture
def loaded(monkeypatch):
    """Exchange mpi4py for the stand-in, as if the user's script had imported it."""

    def load(**settings):
        package = ModuleType("mpi4py")
        package.MPI = stand_in(**settings)
        monkeypatch.setitem(sys.modules, "mpi4py", package)
        monkeypatch.setitem(sys.modules, "mpi4py.MPI", package.MPI)
        return package.MPI

    return load


def test_nothing_is_imported_for_a_process_alone():
    assert mpi_communicator(None) is None
    assert mpi_communicator("world") is None
    assert "mpi4py" not in sys.modules


@pytest.mark.parametrize("name", [*LAUNCHERS, "mpi4py.run"])
def test_the_world_is_that_of_mpi_wherever_something_has_launched_it(name, loaded, monkeypatch):
    mpi = loaded(world=4)
    monkeypatch.delitem(sys.modules, "mpi4py.MPI")
    if name == "mpi4py.run":
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    else:
        monkeypatch.setenv(name, "4")
    monkeypatch.setattr(mpi_module, "mpi", lambda: sys.modules.setdefault("mpi4py.MPI", mpi))
    assert mpi_communicator("world") is mpi.COMM_WORLD


def test_a_step_of_one_task_is_no_launch(monkeypatch):
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "1")
    assert mpi_communicator("world") is None


@pytest.mark.parametrize("comm", ["wrold", 91, b"world", Intracomm(2)])
def test_another_type_is_refused_without_mpi(comm):
    with pytest.raises(
        psf.errors.ModelError, match=r"comm must be None, 'world' or an intracomm.*, got "
    ):
        mpi_communicator(comm)
    assert "mpi4py" not in sys.modules


def test_other_objects_of_mpi_are_refused(loaded):
    loaded()
    with pytest.raises(psf.errors.ModelError, match="intracommunicator"):
        mpi_communicator(Comm(2))
    with pytest.raises(psf.errors.ModelError, match=r"got MPI.COMM_NULL: it was freed, or"):
        mpi_communicator(Comm(0))


@pytest.mark.parametrize(
    ("state", "words"),
    [
        ({"initialized": False}, "MPI is not initialized"),
        ({"finalized": True}, "MPI was already finalized"),
    ],
)
def test_mpi_must_be_running(loaded, state, words):
    mpi = loaded(**state)
    with pytest.raises(psf.errors.ParallelError, match=words):
        mpi_communicator(mpi.COMM_WORLD)


def test_mpi4py_is_missing(monkeypatch):
    monkeypatch.setenv("PMI_SIZE", "2")
    monkeypatch.setitem(sys.modules, "mpi4py", None)
    with pytest.raises(psf.errors.ParallelError, match="pip install mpi4py"):
        mpi_communicator("world")


@pytest.mark.parametrize("error", [RuntimeError, ImportError])
def test_the_library_is_missing(monkeypatch, error):
    class Package(ModuleType):
        def __getattr__(self, name):
            if name == "MPI":
                raise error("cannot load MPI library\nlibmpi.so: cannot open\nlibmpi.so.40: not")
            raise AttributeError(name)

    monkeypatch.setenv("PMI_SIZE", "2")
    monkeypatch.setitem(sys.modules, "mpi4py", Package("mpi4py"))
    cures = r"\(cannot load MPI library\).*filters\[mpi\]'.*apt install.*module load"
    with pytest.raises(psf.errors.ParallelError, match=cures):
        mpi_communicator("world")


@pytest.mark.parametrize("variable", LAUNCHERS[:-1])
@pytest.mark.parametrize("comm", ["world", Intracomm(1)])
def test_a_launcher_of_another_mpi(variable, comm, loaded, monkeypatch):
    loaded(world=1)
    monkeypatch.setenv(variable, "4")
    words = rf"4 ranks were started together \({variable}=4\), but none sees .*Open MPI"
    with pytest.raises(psf.errors.ParallelError, match=words):
        mpi_communicator(comm)


def test_a_small_communicator_of_a_large_world_is_no_wrong_launch(loaded, monkeypatch):
    loaded(world=4)
    monkeypatch.setenv("OMPI_COMM_WORLD_SIZE", "4")
    alone = Intracomm(1)
    assert mpi_communicator(alone) is alone


def test_threads_that_may_not_call_mpi(loaded):
    loaded(threads=3)
    mpi_module.check_threads()
    loaded(threads=1)
    with pytest.raises(psf.errors.ParallelError, match=r"MPI_THREAD_MULTIPLE.*per_chain of 1"):
        mpi_module.check_threads()


HERE = {"numba": "0.68.0", "numpy": "2.4", "processor": "znver3"}


def test_ranks_that_are_alike():
    with warnings.catch_warnings(action="error"):
        environment.check_environments([HERE] * 3, 0, in_lockstep=True)
    assert environment.describe_environment()["processor"]


def test_ranks_that_differ_may_run_chains():
    reports = [HERE, HERE | {"numba": "0.61.2"}, HERE]
    words = "The ranks differ: numba 0.68.0 on ranks 0, 2, 0.61.2 on rank 1. The draws"
    with pytest.warns(psf.errors.ParallelWarning, match=words):
        environment.check_environments(reports, 0, in_lockstep=False)
    with warnings.catch_warnings(action="error"):
        environment.check_environments(reports, 1, in_lockstep=False)


def test_ranks_that_differ_may_not_share_a_likelihood():
    reports = [HERE, HERE | {"processor": "skylake"}]
    words = "same environment, got processor znver3 on rank 0, skylake on rank 1. .*NUMBA_CPU_NAME="
    for rank in range(2):
        with pytest.raises(psf.errors.ParallelError, match=words):
            environment.check_environments(reports, rank, in_lockstep=True)


# A computer whose MPI library cannot be loaded: nothing is said until ``comm=`` asks for it.


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
