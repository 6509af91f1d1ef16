"""Ranks that are threads of this process: what MPI's exchange does, with a barrier."""

import ctypes
import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Barrier, BrokenBarrierError
from typing import Any

import numpy as np

from pymc_statespace_filters.parallel.communicator import Communicator, Message
from tests.waiting import LIMIT

_EXCHANGE = ctypes.CFUNCTYPE(
    None, ctypes.POINTER(ctypes.c_double), ctypes.c_ssize_t, ctypes.c_ssize_t, ctypes.c_ssize_t
)


class FakeRank:
    """One of several ranks, with the face of `parallel.Ranks` towards filters.

    ``exchanged`` lists the (rows, columns, columns of a block) of every array completed so far.
    """

    def __init__(self, rank: int, size: int, table: list, barrier: Barrier, letters: list):
        self.rank, self.size, self.exchanged, self._letters = rank, size, [], letters
        self._table, self._barrier, self._error = table, barrier, None
        self._callback = _EXCHANGE(self._called)
        self.exchange = ctypes.cast(self._callback, ctypes.c_void_p).value if size > 1 else 0

    def check_exchange(self) -> None:
        """Raise what an exchange met."""
        if self._error is not None:
            raise self._error

    def send(self, to: int, kind: str, value: Any = None) -> None:
        """Send a message, by value as MPI does."""
        self._letters[to].put(pickle.dumps(Message(self.rank, kind, value)))

    send_to_others = Communicator.send_to_others

    def receive(self) -> Message | None:
        """Take the next message, if there is one."""
        if self._barrier.broken:
            raise BrokenBarrierError
        with suppress(Empty):
            return pickle.loads(self._letters[self.rank].get_nowait())
        return None

    def abort(self, error: BaseException) -> None:
        """End what the others wait for."""
        self._barrier.abort()

    def _called(self, address: Any, rows: int, columns: int, per_block: int) -> None:
        if self._error is None:
            try:
                self._complete(np.ctypeslib.as_array(address, (rows, columns)), per_block)
            except BaseException as error:
                self._error = error
                self._barrier.abort()

    def _complete(self, array: np.ndarray, per_block: int) -> None:
        self.exchanged.append((*array.shape, per_block))
        self._table[self.rank] = array
        self._barrier.wait()
        for rank, theirs in enumerate(self._table):
            assert theirs.shape == array.shape
            if rank != self.rank:
                local = _part(rank, self.size, array.shape[1], per_block)
                array[:, local] = theirs[:, local]
        self._barrier.wait()


def _part(rank: int, size: int, columns: int, per_block: int) -> slice:
    n_blocks = -(-columns // per_block)
    ends = [min(per_block * (n_blocks * r // size), columns) for r in (rank, rank + 1)]
    return slice(*ends)


def on_ranks(size: int, call: Callable[[FakeRank], Any]) -> list:
    """Results of ``call(rank)`` of every rank, all at once; the first error, if there is one."""
    table, barrier, errors = [None] * size, Barrier(size, timeout=LIMIT), []
    letters = [SimpleQueue() for _ in range(size)]
    ranks = [FakeRank(rank, size, table, barrier, letters) for rank in range(size)]

    def run(rank: FakeRank) -> Any:
        try:
            result = call(rank)
            rank.check_exchange()
            return result
        except BaseException as error:
            errors.append(error)  # those of other ranks are its consequences
            barrier.abort()

    with ThreadPoolExecutor(size) as pool:
        results = list(pool.map(run, ranks))
    if errors:
        raise errors[0]
    return results
