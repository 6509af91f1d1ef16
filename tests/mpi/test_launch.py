"""The harness itself: ranks are real, and a job always ends."""

import os
import signal
import subprocess
import sys

import pytest

from tests.mpi.launch import ROOT, Job, mpiexec, on_ranks
from tests.waiting import LIMIT, wait_until


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


# What the package says of a launch by which ranks cannot work together, with the real mpi4py.


SIZE = """
import sys
from pymc_statespace_filters.parallel.communicator import communicator_of
ranks = communicator_of("world")
print("mpi4py" in sys.modules, ranks.size)
"""


def alone(*arguments, **environment):
    """Run the script in a process that no mpiexec started."""
    return subprocess.run(
        [sys.executable, *arguments, "-c", SIZE],
        cwd=ROOT,
        env=os.environ | {"OMPI_MCA_pml": "ob1", "OMPI_MCA_btl": "self"} | environment,
        capture_output=True,
        timeout=LIMIT,
        text=True,
        check=False,
    )


def test_no_mpiexec_is_needed_for_one_rank():
    done = alone("-W", "error", "-m", "mpi4py", PATH="/usr/bin:/bin")
    assert (done.returncode, done.stdout, done.stderr) == (0, "True 1\n", "")


def test_a_library_that_is_not_there():
    done = alone("-m", "mpi4py", MPI4PY_MPIABI="none")
    assert done.returncode == 1
    assert "ParallelError: mpi4py finds no MPI library" in done.stderr
    assert "pip install 'pymc-statespace-filters[mpi]'" in done.stderr


def test_a_launcher_of_another_mpi():
    done = alone(PMI_SIZE="4", PMI_RANK="0")
    assert done.returncode == 1
    assert "ParallelError: 4 ranks were started together (PMI_SIZE=4)" in done.stderr


def refusals(comm):
    from mpi4py import MPI

    from pymc_statespace_filters.errors import ModelError, ParallelError
    from pymc_statespace_filters.parallel.communicator import communicator_of

    freed = comm.Dup()
    freed.Free()
    left_out = comm.Split(0 if comm.rank == 0 else MPI.UNDEFINED)
    heard = []
    for wrong in [freed, comm.Get_group(), comm.handle, left_out if comm.rank else MPI.COMM_NULL]:
        with pytest.raises(ModelError) as caught:
            communicator_of(wrong)
        heard.append(str(caught.value))
    with pytest.raises(ParallelError) as caught:
        communicator_of(comm).groups(2)
    return [*heard, str(caught.value), communicator_of(comm.Split(comm.rank)).size]


def test_communicators_that_cannot_be_used():
    for heard in on_ranks(2, refusals, env={"MPI4PY_RC_THREAD_LEVEL": "serialized"}):
        freed, group, handle, left_out, threads, size = heard
        assert "got MPI.COMM_NULL" in freed
        assert "got MPI.COMM_NULL" in left_out
        assert "an intracommunicator of mpi4py, got <mpi4py.MPI.Group" in group
        assert "an intracommunicator of mpi4py, got " in handle
        assert "MPI_THREAD_MULTIPLE" in threads
        assert size == 1


def different(comm):
    if comm.rank == 1:
        os.environ |= {"NUMBA_CPU_NAME": "nocona", "NUMBA_CPU_FEATURES": ""}
    from pymc_statespace_filters.errors import ParallelError, ParallelWarning
    from pymc_statespace_filters.parallel.communicator import communicator_of

    with pytest.raises(ParallelError, match=r"nocona .* on rank 1.* NUMBA_CPU_NAME=x86-64-v3"):
        communicator_of(comm, in_lockstep=True)
    if comm.rank == 1:
        return communicator_of(comm, in_lockstep=False).size
    with pytest.warns(ParallelWarning, match=r"The ranks differ: processor .* on rank 0, nocona"):
        return communicator_of(comm, in_lockstep=False).size


def test_ranks_on_different_processors():
    assert on_ranks(2, different) == [2, 2]
