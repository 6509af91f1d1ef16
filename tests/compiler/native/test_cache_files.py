"""Compiled code on disk: files that are damaged, folders that cannot be written."""

import errno
import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from pickle import UnpicklingError
from threading import Timer
from types import FunctionType
from uuid import uuid4

import pytest
from numba import njit, types
from pytensor import config

from pymc_statespace_filters.compiler.codegen import machine_code
from pymc_statespace_filters.compiler.codegen.machine_code import kept
from pymc_statespace_filters.compiler.native import entry_point
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint
from tests.waiting import LIMIT

ROOT = Path(__file__).parents[3]


def _nothing(n):
    pass


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_a_damaged_file_is_compiled_anew(ending):
    point = made()
    folder = Path(config.base_compiledir, "numba")
    before = set(folder.iterdir())
    point.compile()
    new = set(folder.iterdir()) - before  # other processes compile too
    (file,) = [p for p in new if p.suffix == f".{ending}" and "_nothing" in p.name]
    whole = file.read_bytes()
    file.write_bytes(whole[:40])
    del entry_point._compiled[point.symbol]
    point.compile()
    assert len(file.read_bytes()) > 0.9 * len(whole)  # for the next process


def made(needs=(), text=None):
    """An entry point that nobody has compiled, unless one of this text."""
    inside = FunctionType(_nothing.__code__, {"__name__": entry_point.__name__}, "_nothing")
    return EntryPoint(inside, {"n": types.intp}, "nothing", (text or uuid4().hex,), needs)


def test_it_is_known_what_needs_no_compilation():
    needed = made()
    point = made([needed])
    assert not needed.is_compiled
    point.compile()
    assert point.is_compiled
    for one in (needed, point):
        del entry_point._compiled[one.symbol]
        assert one.is_compiled  # on disk
    other = made()
    entry_point._compiled.pop(point.symbol, None)
    assert not made([other]).is_compiled
    assert other.symbol not in entry_point._compiled


HOLD = """
import sys, time
from filelock import FileLock
lock = FileLock(sys.argv[1])
lock.acquire()
print("held", flush=True)
time.sleep(600.0)
"""


@pytest.fixture
def owner():
    """A function that starts a process which holds the lock of an entry point."""
    with ExitStack() as stack:

        def owner(point):
            path = f"{point._callback()._cache._cache_file._index_path}.lock"
            process = subprocess.Popen([sys.executable, "-c", HOLD, path], stdout=subprocess.PIPE)
            stack.enter_context(process)
            stack.callback(process.kill)
            assert process.stdout.readline() == b"held\n"
            return process, Path(path)

        yield owner


COMPILE = """
import sys
from pymc_statespace_filters.compiler.native import entry_point
from tests.compiler.native.test_cache_files import made

compiled = made(text=sys.argv[1])._callback()
with entry_point._one_process(compiled):
    print("begun", flush=True)
    sys.stdin.readline()
    compiled.compile()
"""


def test_who_waits_for_a_process_that_compiles_loads_its_code():
    text = uuid4().hex
    command = [sys.executable, "-c", COMPILE, text]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT, text=True
    ) as other:
        assert other.stdout.readline() == "begun\n"
        timer = Timer(0.2, other.stdin.close)
        timer.start()
        point = made(text=text)
        point.compile()
        assert not timer.is_alive()
    assert entry_point._compiled[point.symbol].cache_hits == 1


def test_who_waits_for_a_process_that_is_killed_compiles(owner):
    point = made()
    process, path = owner(point)
    timer = Timer(0.2, process.kill)
    timer.start()
    point.compile()
    timer.join()  # it was not compiled before
    assert process.wait(LIMIT) != 0
    assert not path.exists()


def test_patience_with_another_process_ends(owner, monkeypatch):
    monkeypatch.setattr(entry_point, "PATIENCE", 0.1)
    point = made()
    process, path = owner(point)
    point.compile()
    assert process.poll() is None
    assert path.exists()  # for others who wait


def test_without_locks_each_process_compiles(monkeypatch):
    def no_lock(*arguments, **options):
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr(entry_point.FileLock, "acquire", no_lock)
    point = made()
    point.compile()
    assert point.is_compiled


def test_a_damaged_file_of_a_module_is_compiled_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(machine_code, "NUMBA_CACHE_PATH", tmp_path)
    made = []

    def make():
        made.append(b"code")
        return made[-1]

    assert kept("a", make) == kept("a", make) == b"code"
    (file,) = tmp_path.iterdir()
    assert len(made) == 1
    for damaged in (file.read_bytes()[:-1], file.read_bytes()[:10], b""):
        file.write_bytes(damaged)
        assert kept("a", make) == b"code"
        assert kept("a", make) == b"code"
    assert len(made) == 4
    assert list(tmp_path.iterdir()) == [file]  # nothing half written is left


def test_a_module_is_used_where_no_file_can_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(machine_code, "NUMBA_CACHE_PATH", tmp_path / "no such folder")
    assert kept("b", lambda: b"code") == b"code"


GRAPH = """
import sys
import numba, pytensor, pytensor.tensor as pt
from pymc_statespace_filters.pymc_model.density import compile_density

x = pt.dvector()
graph = pt.exp(x[0] + x[1])
if sys.argv[1] == "damaged":
    try:
        pytensor.function([x], graph, mode="NUMBA")([0.0, 0.0])
    except Exception:
        print("PyTensor's own affair")
print(compile_density([x], [graph])([0.0, 0.0])[0])
"""


def _run_graph(folder, files):
    flags = {"PYTENSOR_FLAGS": f"base_compiledir={folder.as_posix()},blas__ldflags=,cxx="}
    command = [sys.executable, "-c", GRAPH, files]
    run = subprocess.run(
        command, env=os.environ | flags, capture_output=True, text=True, timeout=LIMIT
    )
    return run.stdout


def test_damaged_files_of_pytensor_are_compiled_anew_in_a_density(tmp_path):
    """Of one function the index, of the next the code."""
    assert _run_graph(tmp_path, "whole") == "1.0\n"
    indices = sorted(tmp_path.rglob("*.nbi"))
    assert len(indices) > 1
    files = indices[::2] + [one for i in indices[1::2] for one in i.parent.glob(f"{i.stem}*.nbc")]
    assert {file.suffix for file in files} == {".nbi", ".nbc"}
    for file in files:
        file.write_bytes(file.read_bytes()[:10])
    assert _run_graph(tmp_path, "damaged") == "PyTensor's own affair\n1.0\n"
    assert all(file.stat().st_size > 10 for file in files)  # for the next process


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_a_damaged_file_of_another_package_is_as_without_this_one(tmp_path, ending):
    """Numba raises what reading the file raised, and leaves the file."""
    path = tmp_path / "other.py"
    path.write_text("def double(x):\n    return 2 * x\n")
    namespace = {"__name__": "other"}
    exec(compile(path.read_text(), str(path), "exec"), namespace)
    double = namespace["double"]
    assert njit(double, cache=True)(1.0) == 2.0
    (file,) = tmp_path.rglob(f"*.{ending}")
    file.write_bytes(file.read_bytes()[:10])
    with pytest.raises((EOFError, UnpicklingError)):
        njit(double, cache=True)(1.0)
    assert file.stat().st_size == 10


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").touch()
    flags = f"base_compiledir={(tmp_path / 'file').as_posix()},cxx="
    run = subprocess.run(
        [sys.executable, "-c", "import pymc_statespace_filters as psf; psf.EKF()"],
        env=os.environ | {"PYTENSOR_FLAGS": flags},
        capture_output=True,
        timeout=LIMIT,
        text=True,
    )
    assert run.returncode == 1
    assert "set PYTENSOR_FLAGS=base_compiledir=FOLDER" in run.stderr.splitlines()[-1]
