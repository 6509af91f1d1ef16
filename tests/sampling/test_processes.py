"""Sampling in other processes and in an event loop: the same draws as anywhere.

All passed on 2026-11-24 (Linux, Python 3.13), in half a minute.
"""

import asyncio
import multiprocessing
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from shutil import which

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from tests.systems import FREE
from tests.waiting import LIMIT

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


def draws():
    """Of two chains on a small record, by two threads."""
    with pm.Model():
        pm.Uniform("a", 0.0, 1.0)
        record = {"steps": range(1, 21), "observed": np.sin(np.arange(20.0))}
        psf.StateSpace("d", FREE, psf.BootstrapPF(30), **record)
        idata = psf.sample_dram(
            50, tune=50, chains=2, cores=2, random_seed=1, progressbar=False,
            compute_convergence_checks=False,
        )  # fmt: skip
    return idata["posterior"]["a"].values


@cache
def expected():
    return draws()


def send(pipe):
    pipe.send(draws())


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # threads, and a fork
@pytest.mark.parametrize("method", ["spawn", "forkserver", "fork"])
def test_a_child_process_draws_the_same(method):
    """Forked, the child has what the parent compiled, and none of its threads."""
    wanted, context = expected(), multiprocessing.get_context(method)
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=send, args=(sender,))
    child.start()
    sender.close()
    try:
        assert receiver.poll(LIMIT), "no draws in time"
        np.testing.assert_array_equal(receiver.recv(), wanted)
        child.join(LIMIT)
        assert child.exitcode == 0
    finally:
        child.kill()


def test_in_an_event_loop_and_in_its_threads():
    async def in_the_loop():
        return draws()

    async def in_threads():
        return await asyncio.gather(asyncio.to_thread(draws), asyncio.to_thread(draws))

    np.testing.assert_array_equal(asyncio.run(in_the_loop()), expected())
    for found in asyncio.run(in_threads()):
        np.testing.assert_array_equal(found, expected())


CHILD = """
import sys
sys.path.insert(0, {root!r})
import pymc_statespace_filters as psf
psf.EKF()  # before PyMC is imported, which says no more than "Permission denied"
from tests.sampling.test_processes import draws
print(draws().sum().hex())
"""


@pytest.mark.parametrize("may_write", [True, False])
def test_without_the_rights_of_root(tmp_path, may_write):
    """Draws the same in a folder of the user's own; otherwise one line says which flag to set."""
    plain = ["setpriv", "--bounding-set=-all", "--inh-caps=-all"] if os.getuid() == 0 else []
    if plain and not which(plain[0]):
        pytest.skip("root may write anywhere, and setpriv is not there to take this away")
    tmp_path.chmod(0o755 if may_write else 0o555)
    run = subprocess.run(
        [*plain, sys.executable, "-c", CHILD.format(root=str(ROOT))],
        env=os.environ
        | {"PYTENSOR_FLAGS": f"base_compiledir={tmp_path.as_posix()},blas__ldflags=,cxx="},
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )
    if may_write:
        assert run.returncode == 0, run.stderr[-2000:]
        assert run.stdout.split()[-1] == expected().sum().hex()
    else:
        assert run.returncode != 0
        assert "set PYTENSOR_FLAGS=base_compiledir=FOLDER" in run.stderr.splitlines()[-1]
