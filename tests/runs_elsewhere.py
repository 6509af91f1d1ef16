"""Tests that only runs with the plugin `tests.elsewhere` have; see `test_portability`."""

import os
from pathlib import Path

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from tests.elsewhere import MISSING
from tests.systems import FREE


def test_nothing_of_linux_is_left(tmp_path):
    assert not any(hasattr(module, name) for module, names in MISSING.items() for name in names)
    with pytest.raises(FileNotFoundError):
        Path("/proc/self/status").read_text(encoding="ascii")
    with pytest.raises(PermissionError):
        os.open(tmp_path, os.O_RDONLY)
    with open(tmp_path / "file", "wb"), pytest.raises(PermissionError):
        os.unlink(tmp_path / "file")


@pytest.mark.usefixtures("interpreted")
def test_a_run_and_its_checkpoint(tmp_path):
    with pm.Model():
        pm.Uniform("a", 0.0, 1.0)
        record = {"steps": range(1, 21), "observed": np.sin(np.arange(20.0))}
        psf.StateSpace("d", FREE, psf.EKF(), **record)
        run = {
            "draws": 100, "tune": 100, "chains": 2, "initvals": {"a": 0.5}, "random_seed": 1,
            "progressbar": False, "compute_convergence_checks": False,
        }  # fmt: skip
        whole = psf.sample_dram(**run)["posterior"]["a"].values
        stored = psf.sample_dram(**run, checkpoint=tmp_path)["posterior"]["a"].values
        resumed = psf.sample_dram(**run, checkpoint=tmp_path)["posterior"]["a"].values
    np.testing.assert_array_equal(stored, whole)
    np.testing.assert_array_equal(resumed, whole)
