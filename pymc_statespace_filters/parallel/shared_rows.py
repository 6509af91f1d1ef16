"""Rows of a calculation over ranks that run one program in step.

All ranks draw the same random numbers and take the same decisions. Where a function is evaluated at
many rows, each rank evaluates some of them and all get all results, so that nothing depends on the
number of ranks. Each collective step tells the others of an error, and of what is evaluated: ranks
that have diverged end with an error, and none waits for another. What depends on the time, such as
a number of evaluations that fits a budget, is decided by the first rank alone.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import pairwise
from threading import Event
from typing import NamedTuple
from zlib import crc32

import numpy as np

from .communicator import Communicator
from .signals import deferred_interrupts, unless_interrupted

_MARKED = 4096  # elements of an array that enter the mark of a step

Arrays = Sequence[np.ndarray]


class _Ranks(NamedTuple):
    comm: Communicator
    interrupted: Event


_ranks: ContextVar[_Ranks | None] = ContextVar("ranks that share rows", default=None)


@contextmanager
def rows_shared_by(comm: Communicator) -> Iterator[None]:
    """Divide the rows of all functions in this thread among ranks, all of which enter the block."""
    if comm.size == 1:
        yield
        return
    with deferred_interrupts() as interrupted:
        token = _ranks.set(_Ranks(comm, interrupted))
        try:
            yield
        finally:
            _ranks.reset(token)


def outlasting_interrupts[R](work: Callable[[], R], otherwise: R) -> R:
    """As `unless_interrupted`; ranks, of which one alone may be interrupted, do all of the work."""
    ranks = _ranks.get()
    if ranks is None:
        return unless_interrupted(work, otherwise)
    token = _ranks.set(ranks._replace(interrupted=Event()))
    try:
        return work()
    finally:
        _ranks.reset(token)


def evaluated_rows(
    evaluate: Callable[[slice], Arrays],
    columns: Arrays,
    empty: Callable[[int], Arrays],
) -> list[np.ndarray]:
    """The results of a function at all rows of some columns, each of the same length m.

    ``evaluate`` has those of a slice of the rows, and ``empty`` makes arrays for those of m rows.
    """
    m, ranks = len(columns[0]), _ranks.get()
    if ranks is None or m < ranks.comm.size:
        return list(evaluate(slice(0, m)))
    comm = ranks.comm
    ends = np.linspace(0, m, comm.size + 1).astype(int).tolist()
    own = slice(*ends[comm.rank : comm.rank + 2])

    def evaluate_own() -> Arrays:
        if ranks.interrupted.is_set():
            raise KeyboardInterrupt
        return evaluate(own)

    results = list(empty(m))
    parts = comm.run_collectively(evaluate_own, _mark(columns))
    for result, part in zip(results, parts, strict=True):
        result[own] = part
    comm.share_rows(results, list(pairwise(ends)))
    return results


def by_first_rank[R](function: Callable[[], R]) -> R:
    """The result of a function that depends on the time: that of the first rank, on all."""
    ranks = _ranks.get()
    if ranks is None:
        return function()
    token = _ranks.set(None)
    try:
        found = ranks.comm.run_collectively(lambda: function() if ranks.comm.rank == 0 else None)
    finally:
        _ranks.reset(token)
    return ranks.comm.broadcast(found)


def _mark(columns: Arrays) -> int:
    """A checksum of the shapes and of some elements of arrays."""
    mark = crc32(repr([column.shape for column in columns]).encode())
    for column in columns:
        some = column.ravel()[:: column.size // _MARKED + 1]
        mark = crc32(np.ascontiguousarray(some), mark)
    return mark
