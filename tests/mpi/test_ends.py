"""How a run over ranks ends: all of them hear of it, and can make the next call.

The last is interrupted on all ranks, as by a mpiexec that hands Ctrl-C on.
"""

import os
import signal
import time
from threading import Event

import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.sampling.run.chain_task import ChainTask
from pymc_statespace_filters.sampling.run.thread_pool import ChainPool
from tests.mpi.launch import on_ranks
from tests.waiting import LIMIT


def ends(comm):
    """What each of several runs in one job comes to."""
    with pm.Model() as model:
        pm.Normal("mu")
    call = {"chains": 2, "cores": 1, "model": model, "random_seed": 1, "comm": comm}
    quick = call | {"draws": 20, "tune": 10}
    heard = []

    with pytest.raises((ValueError, psf.errors.ParallelError)) as caught:
        psf.sample_dram(**quick, progressbar="sideways")
    heard.append(str(caught.value))

    with pytest.MonkeyPatch.context() as patch:
        if comm.rank == 0:
            patch.setattr(ChainTask, "run", _fails_when_others_are_done)
        with pytest.raises((ArithmeticError, psf.errors.ParallelError)) as caught:
            psf.sample_dram(**quick | {"comm": {"comm": comm, "gather": "all"}}, progressbar=False)
    heard.append(str(caught.value))

    made, stop, told, stopped = ChainTask._advance, ChainPool.stop, [], Event()

    def advance_and_interrupt(run):
        made(run)
        if not told:
            told.append(comm.recv(source=1) if comm.rank == 0 else comm.send(None, 0))
            os.kill(os.getpid(), signal.SIGINT)
        stopped.wait(LIMIT)

    def stop_all(pool):
        stopped.set()
        stop(pool)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ChainTask, "_advance", advance_and_interrupt)
        patch.setattr(ChainPool, "stop", stop_all)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        tree = psf.sample_dram(
            10**5,
            tune=0,
            **call | {"comm": {"comm": comm, "gather": "all"}},
            progressbar=False,
            kernel={"proposal_cov": [[1.0]]},
        )
    heard.append(dict(tree["posterior"].sizes))
    return heard


def _fails_when_others_are_done(run, stop):
    time.sleep(1.0)
    raise ArithmeticError("at the end")


def test_all_ranks_come_to_the_same_end():
    zero, one = on_ranks(2, ends)
    assert zero[0] == one[0]
    assert zero[0].startswith("progressbar must be True, False or one of")
    assert zero[1] == "at the end"
    assert one[1] == "rank 0 of 2 has stopped the run: ArithmeticError: at the end"
    assert zero[2] == one[2]
    assert 0 < zero[2]["draw"] < 10**5
