"""Compiled code on disk: files that are damaged, folders that cannot be written."""

import os
import subprocess
import sys
from pathlib import Path
from uuid import uuid4

import pytest
from numba import types
from pytensor import config

from pymc_statespace_filters.compiler.native import entry_point
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint


def _nothing(n):
    pass


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_a_damaged_file_is_compiled_anew(ending):
    key = uuid4().hex
    point = EntryPoint(_nothing, {"n": types.intp}, "nothing", key)
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


SUM = """
import pymc_statespace_filters as psf, pytensor, pytensor.tensor as pt
psf.EKF()
x = pt.dvector()
print(pytensor.function([x], pt.sum(pt.exp(x)), mode="NUMBA")([0.0, 0.0]))
"""


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_damaged_files_of_pytensor_are_compiled_anew(tmp_path, ending):
    def run():
        flags = {"PYTENSOR_FLAGS": f"base_compiledir={tmp_path.as_posix()},blas__ldflags=,cxx="}
        command = [sys.executable, "-c", SUM]
        return subprocess.run(
            command, env=os.environ | flags, capture_output=True, text=True, check=True
        )

    assert run().stdout == "2.0\n"
    files = list(tmp_path.rglob(f"*.{ending}"))
    assert files
    for file in files:
        file.write_bytes(file.read_bytes()[:10])
    assert run().stdout == "2.0\n"
    assert all(file.stat().st_size > 10 for file in files)  # for the next process


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").touch()
    flags = f"base_compiledir={(tmp_path / 'file').as_posix()},cxx="
    run = subprocess.run(
        [sys.executable, "-c", "import pymc_statespace_filters as psf; psf.EKF()"],
        env=os.environ | {"PYTENSOR_FLAGS": flags},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 1
    assert "set PYTENSOR_FLAGS=base_compiledir=FOLDER" in run.stderr.splitlines()[-1]
