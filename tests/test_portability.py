"""Other systems: what Linux alone has is taken away, and the code is made for other processors.

Here are the quick ones; CONTRIBUTING.md says how to run any test without what Linux has.
"""

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytensor.tensor as pt
import pytest
from numba import njit

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.compiler.numerics.normals import fill_normals
from pymc_statespace_filters.compiler.numerics.philox import PROCESS
from pymc_statespace_filters.filters.kernel_density.simd_windows import (
    POINTS,
    add_to_line,
    sum_line,
)
from tests.elsewhere import PLAIN
from tests.waiting import LIMIT

ROOT = Path(__file__).parents[1]
# A run with a checkpoint that is resumed, its files, cores, and interrupts.
WITHOUT_LINUX = (
    "tests/runs_elsewhere.py",
    "tests/parallel/test_shared_rows.py",
    "tests/sampling/test_interrupts.py",
    "tests/sampling/test_checkpoint_file.py",
    "tests/sampling/test_checkpoint_folder.py",
)
on_linux = pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="nothing to take away")


@on_linux
def test_without_what_linux_has():
    command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.elsewhere", "-p", "no:xdist"]
    # Slow and pure Python; and one whose child process has all of Linux.
    named = "every_altered_byte", "torn_anywhere", "free_when_that_is_killed"
    left_out = "-k", " and ".join(f"not {name}" for name in named)
    done = subprocess.run(
        [*command, "-p", "no:cacheprovider", *left_out, *WITHOUT_LINUX],
        cwd=ROOT,
        env=os.environ | PLAIN,
        capture_output=True,
        timeout=LIMIT,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@njit
def window_sum(grid, at, lead, ratio):
    add_to_line(grid, at, 0, lead, ratio, 1.5, 0.0)
    return sum_line(grid, at + 4, 0, lead, ratio, 0.7, 0.0)


def numbers():
    """What is written in vectors, or in instructions that not every processor has.

    A scalar recursion; members moved by normals; and windows of a kernel density, which are written
    in LLVM vectors of four.
    """
    system = psf.StateSpaceModel(
        transition=lambda x, q, a: [a * pt.sin(x[0]) + pt.tanh(x[0] - 1.0) + q[0]],
        process_noise=[[0.3]],
        observation=lambda x: [pt.exp(0.3 * x[0])],
        observation_noise=[[0.1]],
        initial_mean=[0.5],
        initial_cov=[[0.2]],
    )
    record = {"steps": np.arange(1, 31), "observed": np.exp(0.3 * np.sin(np.arange(30.0)))}
    terms = psf.log_likelihood(system, psf.EKF(), {"a": 1.3}, **record)
    machine, X, Z = compile_system(system), np.linspace(-2.0, 2.0, 64)[None], np.empty((1, 64))
    fill_normals(2, PROCESS, 0, Z)
    machine.propagate.function(
        machine.prepare.function(np.array([1.3])), np.zeros((1, 0)), 0, 0.0, Z, X
    )
    grid = np.linspace(0.0, 1.0, 2 * POINTS)
    total = window_sum(grid, 7, 1e-3, 0.9)
    return np.concatenate([terms, Z[0], X[0], grid, [total]])


def test_machine_code_of_another_processor():
    """Without AVX and FMA, or NEON's newer instructions: the same to rounding."""
    name = "x86-64" if platform.machine().lower() in {"x86_64", "amd64"} else "generic"
    script = "import sys; from tests.test_portability import numbers; sys.stdout.buffer.write("
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script + "numbers().tobytes())"],
        cwd=ROOT,
        env=os.environ | {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": ""},
        stdout=subprocess.PIPE,
        timeout=LIMIT,
        check=True,
    )
    here = numbers()
    there = np.frombuffer(done.stdout).reshape(here.shape)
    np.testing.assert_allclose(there, here, rtol=1e-11, atol=1e-11)
