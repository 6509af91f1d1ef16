"""The exchanges of an evaluation, counted and timed."""

import ctypes
import time
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numba import njit

from benchmarks.mpi.cases import Case, Ranks, evaluation
from pymc_statespace_filters.filters.ensemble.reductions import BLOCKS, RankLayout, allgather
from tests.ranks import FakeRank, on_ranks

N_TOLLS = 200
SIGNATURE = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_ssize_t, ctypes.c_ssize_t
)
"""Arguments of an exchange: address of an array, rows, columns, columns per block."""


class Watched:
    """A communicator that counts and times the exchanges of another one."""

    def __init__(self, ranks: Ranks, clock: Callable[[], float]):
        self.rank, self.size, self.check_exchange = ranks.rank, ranks.size, ranks.check_exchange
        self.seconds, self.n_bytes = 0.0, []
        self._clock, self._inner = clock, SIGNATURE(ranks.exchange) if ranks.size > 1 else None
        self._callback = SIGNATURE(self._call)
        self.exchange = ctypes.cast(self._callback, ctypes.c_void_p).value if ranks.size > 1 else 0

    def forget(self) -> None:
        """Reset the counts."""
        self.seconds, self.n_bytes = 0.0, []

    def _call(self, address: int, rows: int, columns: int, per_block: int) -> None:
        start = self._clock()
        self._inner(address, rows, columns, per_block)
        self.seconds += self._clock() - start
        self.n_bytes.append(8 * rows * columns)


class Cost(NamedTuple):
    """CPU seconds of the busiest rank apart from its exchanges; their number and bytes."""

    compute: float
    n_exchanges: int
    n_bytes: int


def cost(case: Case, n_ranks: int, seed: int) -> Cost:
    """Return the cost of an evaluation on each of so many ranks, without a network.

    The ranks are threads, of which this machine runs few at a time, so each has its own CPU time.
    """

    def run(rank: FakeRank) -> tuple[Cost, float]:
        watched = Watched(rank, time.thread_time)
        evaluate = evaluation(case, watched)
        start = time.thread_time()
        value = evaluate(seed)
        taken = time.thread_time() - start - watched.seconds
        n_exchanges = len(watched.n_bytes)
        return Cost(taken - n_exchanges * toll(n_ranks), n_exchanges, sum(watched.n_bytes)), value

    toll(n_ranks)
    costs, values = zip(*on_ranks(n_ranks, run), strict=True)
    if len(set(values)) > 1:
        raise RuntimeError(f"{case.name}: {n_ranks} ranks do not agree: {set(values)}")
    return max(costs)


@cache
def toll(n_ranks: int) -> float:
    """Return CPU seconds from machine code to `Watched` and back, on so many threads.

    The model counts them as part of an exchange.
    """

    def run(rank: FakeRank) -> float:
        watched = Watched(rank, time.thread_time)
        layout, local = RankLayout(rank.rank, n_ranks, watched.exchange), array.copy()
        many_exchanges(layout, local, N_TOLLS)
        watched.forget()
        start = time.thread_time()
        many_exchanges(layout, local, N_TOLLS)
        return (time.thread_time() - start - watched.seconds) / N_TOLLS

    array = np.zeros((1, n_ranks))
    many_exchanges(RankLayout(0, 1, 0), array, 1)
    return min(on_ranks(n_ranks, run))


@njit(nogil=True)
def many_exchanges(layout, array, n):
    for _ in range(n):
        allgather(layout, array, BLOCKS)
