"""What `parallel.Communicator` promises, on real ranks."""

import ctypes
import time

import numpy as np
import pytest

from pymc_statespace_filters.errors import ParallelError
from pymc_statespace_filters.parallel import communicator
from pymc_statespace_filters.parallel.communicator import communicator_of
from tests.mpi.launch import on_ranks


def collectives(comm):
    with communicator_of(comm) as ranks:
        assert (ranks.rank, ranks.size) == (comm.rank, comm.size)
        assert ranks.allgather(ranks.rank**2) == [r**2 for r in range(ranks.size)]
        assert ranks.broadcast({"of": ranks.rank}) == {"of": 0}
        assert ranks.run_collectively(lambda: ranks.rank) == ranks.rank
        place, values = ranks.node_local(ranks.rank)
        assert (place, values) == (ranks.rank, list(range(ranks.size)))
        ranks.barrier()


def fail_on_the_last(comm):
    def function():
        if comm.rank == comm.size - 1:
            raise LookupError("not here")

    try:
        communicator_of(comm).run_collectively(function)
    except (LookupError, ParallelError) as error:
        return communicator.describe_error(error)


def messages(comm):
    """Each writes to the next, which takes what comes."""
    with communicator_of(comm) as ranks:
        ranks.send((ranks.rank + 1) % ranks.size, "greeting", {"from": ranks.rank})
        message = None
        while message is None:
            message = ranks.receive()
            time.sleep(0.001)
        before = (ranks.rank - 1) % ranks.size
        assert message == (before, "greeting", {"from": before})
        assert ranks.receive() is None


def arrays(comm):
    """Of all shapes, in pieces that are smaller than they are."""
    communicator._MAX_BYTES = 40
    sent = [
        np.arange(12.0).reshape(3, 4),
        np.empty((0, 2)),
        np.array(7),
        np.arange(100, dtype="u1"),
    ]
    with communicator_of(comm) as ranks:
        if ranks.rank == 0:
            ranks.send_arrays(1, sent)
        if ranks.rank == 1:
            taken = [np.zeros_like(array) for array in sent]
            ranks.receive_arrays(0, taken)
            for mine, theirs in zip(taken, sent, strict=True):
                np.testing.assert_array_equal(mine, theirs)


def groups(comm):
    with communicator_of(comm) as ranks:
        group, leaders = ranks.groups(2)
        alone, all_of_them = ranks.groups(1)
        assert (alone.size, all_of_them.size) == (1, ranks.size)
        all_of_them.close()
        where = group.rank, group.size, None if leaders is None else (leaders.rank, leaders.size)
        group.close()
        if leaders is not None:
            leaders.close()
        return where


def exchanges(comm):
    """Each array is completed, whoever has which blocks of it, and known again at its address."""
    with communicator_of(comm) as ranks:
        call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, *[ctypes.c_ssize_t] * 3)(ranks.exchange)
        for rows, columns, per_block in [(1, 400, 64), (3, 300, 64), (2, 9, 1), (3, 300, 64)]:
            whole = np.arange(float(rows * columns)).reshape(rows, columns)
            mine = np.full_like(whole, np.nan)
            blocks = -(-columns // per_block)
            first, last = (
                per_block * (blocks * r // ranks.size) for r in (comm.rank, comm.rank + 1)
            )
            mine[:, first:last] = whole[:, first:last]
            call(mine.ctypes.data, rows, columns, per_block)
            ranks.check_exchange()
            np.testing.assert_array_equal(mine, whole)


def all_of_it(comm):
    collectives(comm)
    messages(comm)
    arrays(comm)
    exchanges(comm)
    return fail_on_the_last(comm), groups(comm)


def test_four_ranks():
    heard, places = zip(*on_ranks(4, all_of_it), strict=True)
    told = "ParallelError: rank 3 of 4 has stopped the run: LookupError: not here"
    assert heard == (told, told, told, "LookupError: not here (on rank 3 of 4)")
    assert places == ((0, 2, (0, 2)), (1, 2, None), (0, 2, (1, 2)), (1, 2, None))


def test_one_rank_sends_nothing():
    with communicator_of(None) as ranks:
        assert (ranks.rank, ranks.size, ranks.exchange) == (0, 1, 0)
        assert ranks.allgather("x") == ["x"]
        assert ranks.broadcast("x") == ranks.run_collectively(lambda: "x") == "x"
        assert ranks.receive() is None
        assert ranks.node_local("x") == (0, ["x"])
        ranks.check_exchange()
        with pytest.raises(LookupError):
            ranks.run_collectively(lambda: {}["x"])
