"""Real ranks that share a chain: the draws of one rank, and an end for all of them."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.parallel.communicator import Communicator
from pymc_statespace_filters.sampling.target import leader_follower as lockstep
from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings
from pymc_statespace_filters.sampling.target.target import Target
from tests.mpi.launch import mpiexec, on_ranks
from tests.sampling.test_one_chain_on_ranks import led, run_chain, two_records

MODEL = two_records(psf.EnKF(256), psf.BootstrapPF(300))


def chain(group=None):
    draws, state, spread = run_chain(Target(MODEL, None, RandomWalkSettings(), group=group))
    return *draws, *state, np.array(spread)


def chain_together(comm):
    with Communicator(comm) as ranks:
        return led(ranks, chain, ranks)


@pytest.fixture(scope="module")
def alone():
    return chain()


@pytest.mark.parametrize("n", [1, 2])
def test_a_chain_is_that_of_no_ranks_at_all(alone, n):
    together, *rest = on_ranks(n, chain_together)
    assert rest == [None] * (n - 1)
    for values, expected in zip(together, alone, strict=True):
        np.testing.assert_array_equal(values, expected)


def fail(rank):
    """Share a chain, of which one rank runs out of memory in the midst of an evaluation."""
    from mpi4py import MPI

    distributed_evaluator = lockstep.distributed_evaluator

    def failing(system, filter, ranks):
        evaluate, calls = distributed_evaluator(system, filter, ranks), []

        def evaluate_or_fail(*arguments):
            calls.append(arguments)
            if ranks.rank == rank and len(calls) == 5:
                raise MemoryError("not enough for all members")
            return evaluate(*arguments)

        return evaluate_or_fail

    lockstep.distributed_evaluator = failing
    lockstep._ANSWER_SECONDS = 1.0
    with Communicator(MPI.COMM_WORLD) as ranks:
        led(ranks, chain, ranks)


@pytest.mark.parametrize("rank", [0, 1])
def test_a_rank_that_fails_in_an_evaluation_ends_the_job(alone, rank):
    """Also without ``-m mpi4py``, which ends a job only when a rank's script has ended."""
    script = f"from tests.mpi.test_one_chain_on_ranks import fail; fail({rank})"
    done = mpiexec(2, ["-c", script], abort=False)
    assert done.status != 0
    assert "MemoryError: not enough for all members" in done.stderr
    if rank == 1:
        assert "on rank 1 of the 2 that run a chain together" in done.stderr
