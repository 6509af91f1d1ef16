"""The harness itself: ranks are real, and a job always ends."""

import signal

import pytest

from tests.mpi.launch import Job, mpiexec, on_ranks
from tests.waiting import wait_until


def meet(comm, number):
    return comm.rank, comm.size, comm.allreduce(number + comm.rank)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_ranks_are_real(n):
    total = 10 * n + n * (n - 1) // 2
    assert on_ranks(n, meet, 10) == [(rank, n, total) for rank in range(n)]


def fail(comm):
    if comm.rank == 1:
        raise ValueError("a rank that raises")
    comm.barrier()


def test_an_error_of_one_rank_is_reported():
    with pytest.raises(AssertionError, match="a rank that raises"):
        on_ranks(2, fail)


WAIT = """
from time import sleep
from mpi4py import MPI
MPI.COMM_WORLD.barrier()
sleep(30)
"""


def test_a_job_that_hangs_is_ended_and_none_of_it_is_left():
    job = Job(2, "-c", WAIT)
    with pytest.raises(AssertionError, match="still running after 2 s"):
        job.wait(timeout=2)
    assert not job.processes()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_mpiexec_ends_all_ranks(number):
    job = Job(2, "-c", WAIT)
    wait_until(lambda: len(job.ranks()) >= 2)
    job.process.send_signal(number)
    done = job.wait()
    assert done.status != 0
    assert not job.processes()


def test_exit_statuses():
    assert mpiexec(2, ["-c", "from mpi4py import MPI"]).status == 0
    assert mpiexec(2, ["-c", "import sys; from mpi4py import MPI; sys.exit(3)"]).status == 3
