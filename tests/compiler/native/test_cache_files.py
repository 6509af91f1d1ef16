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
    (file,) = [p for p in set(folder.iterdir()) - before if p.suffix == f".{ending}"]
    whole = file.read_bytes()
    file.write_bytes(whole[:40])
    del entry_point._compiled[point.symbol]
    point.compile()
    assert len(file.read_bytes()) > 0.9 * len(whole)  # for the next process


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").touch()
    flags = f"base_compiledir={tmp_path / 'file'},cxx="
    run = subprocess.run(
        [sys.executable, "-c", "import pymc_statespace_filters as psf; psf.EKF()"],
        env=os.environ | {"PYTENSOR_FLAGS": flags},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 1
    assert "set PYTENSOR_FLAGS=base_compiledir=FOLDER" in run.stderr.splitlines()[-1]
