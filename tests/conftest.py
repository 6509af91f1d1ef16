"""What every test run needs before numpy and PyTensor are imported."""

import gc
import os
import signal
from contextlib import nullcontext
from pathlib import Path

import pytest

from tests.costs import Costs
from tests.waiting import limited

# One BLAS thread: the matrices are small, and the test processes already fill the cores.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

# A compilation cache of the tests' own: they neither fill the user's cache nor are fed by it.
# No C compiler: numba needs none, and each operation that C code is made of takes a second. No BLAS
# to link C code against either: the search for one ends in a warning. No lines of source are kept
# with each node of a graph, which takes a tenth of the time to build one.
CACHE = Path(__file__).parents[1] / ".cache" / "pytensor"
FLAGS = f"base_compiledir={CACHE.as_posix()},blas__ldflags=,cxx=,traceback__limit=0"
os.environ.setdefault("PYTENSOR_FLAGS", FLAGS)

# Compilation makes millions of objects that stay, which the garbage collector would visit over and
# over: a twentieth of the time.
gc.set_threshold(50_000, 20, 10)

# Pictures are drawn without a screen.
os.environ.setdefault("MPLBACKEND", "agg")

# Files that take longest, which come first: at the end one process would wait for the other.
# Neighbours share no system, so that the two processes do not compile the same code at once.
LONGEST = (
    "filters/test_ensemble_states.py",
    "sampling/test_race.py",
    "filters/test_truth_regimes.py",
    "point_estimation/test_maximum_likelihood.py",
    "sampling/test_sample_dram.py",
    "filters/test_sigma_points.py",
    "sampling/test_particle_number.py",
    "filters/test_outside_filters.py",
    "test_processes.py",
    "pymc_model/test_jax_samplers.py",
    "system/test_integrators.py",
    "pymc_model/test_in_pymc.py",
    "sampling/test_noisy_chains.py",
    "terms/test_select_terms.py",
    "sampling/test_checkpoint_resume.py",
    "filters/test_finite_state.py",
    "sampling/test_one_chain_on_ranks.py",
    "compiler/test_large_states.py",
    "sampling/test_record_chains.py",
    "test_portability.py",
)


def pytest_addoption(parser):
    parser.addoption("--costs", help="file to which a line of JSON is added for each test file")


def pytest_configure(config):
    """Say how pytest-xdist goes about it, and count compilations.

    Nothing is said of a compilation, which takes as long as the machine lets it.
    """
    from pymc_statespace_filters import progress

    progress.PATIENCE = 3600.0
    # Files are given to the processes in our order, not by their numbers of tests.
    config.option.loadscopereorder = False
    # A process that dies ends the run, which might wait for ever for the one in its place.
    config.option.maxworkerrestart = "0"
    config.pluginmanager.register(Costs(config.option.costs))


def pytest_collection_modifyitems(items):
    """Put the longest files first."""
    tests = Path(__file__).parent
    order = {tests / name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path, len(LONGEST)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """A test that hangs fails, with its fixtures; calibrations take as long as they take."""
    with nullcontext() if item.get_closest_marker("slow") else limited():
        return (yield)


@pytest.fixture(scope="module")
def interpreted():
    """PyTensor's graphs run in Python, for files whose subject they are not.

    Machine code of a graph takes seconds to compile. The functions of filters and systems are
    machine code in either mode, and the same.
    """
    import pytensor

    from tests.modes import AS_IT_STANDS

    with pytensor.config.change_flags(mode=AS_IT_STANDS):
        yield


@pytest.fixture
def without_compilation(monkeypatch):
    """The check at the end of a run takes all filters for compiled ones, whatever is on disk."""
    from pymc_statespace_filters.pymc_model.filter_estimates import VariableAtPoints

    monkeypatch.setattr(VariableAtPoints, "is_compiled", lambda variable, filter: True)


@pytest.fixture
def interrupts_arrive():
    """A shell has them ignored in what it runs in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
