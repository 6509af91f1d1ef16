"""Ranks: the processes that mpiexec started, as the rest of the package sees them.

Without a communicator there is a single rank, for which nothing is sent.
"""

import sys
import time
from collections.abc import Callable, Sequence
from functools import cached_property
from traceback import print_exception
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np

from pymc_statespace_filters.errors import ParallelError
from pymc_statespace_filters.parallel.allgather import Exchange
from pymc_statespace_filters.parallel.environment import check_alike, describe_environment
from pymc_statespace_filters.parallel.mpi import check_threads, communicator, mpi

Result = TypeVar("Result")

# How long a rank that waits for others sleeps between two looks: a busy one takes a core.
_NAP_SECONDS = 0.005
# So long the others let the rank that failed speak first: the first to end may end the whole job.
LAST_WORDS_SECONDS = 1.0
_MOST_BYTES = 2**28  # of one message


class Message(NamedTuple):
    """What a rank was sent: by whom, of what kind, and the value."""

    source: int
    kind: str
    value: Any


class Communicator:
    """A rank among others, with a communicator of its own; a context manager.

    Parameters
    ----------
    comm : mpi4py.MPI.Comm, optional
        Default: this process alone.

    Attributes
    ----------
    rank : int
    size : int
    """

    def __init__(self, comm: Any = None):
        # A duplicate: our messages are never taken for the user's.
        self._comm: Any = None if comm is None or comm.Get_size() == 1 else comm.Dup()
        self.rank: int = 0 if self._comm is None else self._comm.Get_rank()
        self.size: int = 1 if self._comm is None else self._comm.Get_size()
        self._sent: list[Any] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # After an error the others may never come here, and all must for a communicator to go.
        if kind is None:
            self.close()

    def close(self) -> None:
        """Give the communicator back, on all ranks."""
        if self._comm is not None:
            for request in self._sent:
                request.wait()
            self._comm.Free()
            self._comm = None

    # All ranks at once

    def barrier(self) -> None:
        """Wait until every rank is here, without keeping a core busy."""
        if self._comm is not None:
            request = self._comm.Ibarrier()
            while not request.Test():
                time.sleep(_NAP_SECONDS)

    def allgather(self, value: Any) -> list[Any]:
        """The values of all ranks, on all of them."""
        if self._comm is None:
            return [value]
        self.barrier()
        return self._comm.allgather(value)

    def broadcast(self, value: Any = None) -> Any:
        """The value of rank 0, on all ranks."""
        if self._comm is None:
            return value
        self.barrier()
        return self._comm.bcast(value)

    def run_collectively(self, function: Callable[[], Result]) -> Result:
        """Call a function on every rank, and give its result here; if one raises, all do.

        Raises
        ------
        Exception
            What the function raised here.
        ParallelError
            If it raised on another rank, which the message names.
        """
        try:
            result, failure = function(), None
        except BaseException as error:  # an interrupt too: the others are waiting
            failure = error
        reports = self.allgather(None if failure is None else describe_error(failure))
        failed = [rank for rank, report in enumerate(reports) if report is not None]
        if failed and self.rank != failed[0]:
            time.sleep(LAST_WORDS_SECONDS)
        if failure is not None:
            if self._comm is not None:
                failure.add_note(f"on rank {self.rank} of {self.size}")
            raise failure
        if failed:
            raise ParallelError(
                f"rank {failed[0]} of {self.size} has stopped the run: {reports[failed[0]]}"
            )
        return result

    # Messages from one rank to another

    def send(self, to: int, kind: str, value: Any = None) -> None:
        """Send a message, and go on at once."""
        self._sent = [request for request in self._sent if not request.Test()]
        self._sent.append(self._comm.isend((kind, value), to))

    def receive(self) -> Message | None:
        """Take the next message, if there is one."""
        if self._comm is None:
            return None
        status = mpi().Status()
        found = self._comm.improbe(status=status)
        return None if found is None else Message(status.source, *found.recv())

    def send_arrays(self, to: int, arrays: Sequence[np.ndarray]) -> None:
        """Send contiguous arrays, and wait until they are taken."""
        for piece in _pieces(arrays):
            self._comm.Send(piece, to, _ARRAYS)

    def receive_arrays(self, source: int, arrays: Sequence[np.ndarray]) -> None:
        """Fill contiguous arrays with those that a rank sends."""
        for piece in _pieces(arrays):
            self._comm.Recv(piece, source, _ARRAYS)

    def abort(self, error: BaseException) -> None:
        """End the whole job, saying why: others wait for this rank, which will never come."""
        print_exception(error)
        sys.stderr.flush()
        mpi().COMM_WORLD.Abort(1)

    # Groups

    def groups(self, size: int) -> "tuple[Communicator, Communicator | None]":
        """Divide the ranks into groups of consecutive ones.

        Returns
        -------
        Ranks
            The group of this rank.
        Ranks or None
            The first rank of every group, among themselves; None on the others.
        """
        if self._comm is None or size == 1:
            return Communicator(), Communicator(self._comm)
        self.run_collectively(check_threads)
        group = Communicator._owning(self._comm.Split(self.rank // size, self.rank))
        leads = self.rank % size == 0
        leaders = self._comm.Split(0 if leads else mpi().UNDEFINED, self.rank)
        return group, Communicator._owning(leaders) if leads else None

    def node_local(self, value: Any = None) -> tuple[int, list[Any]]:
        """Place among the ranks that share this computer's memory, and the values of all these."""
        if self._comm is None:
            return 0, [value]
        local = self._comm.Split_type(mpi().COMM_TYPE_SHARED)
        place, values = local.Get_rank(), local.allgather(value)
        local.Free()
        return place, values

    @classmethod
    def _owning(cls, comm: Any) -> "Communicator":
        ranks = cls()
        ranks._comm, ranks.rank, ranks.size = comm, comm.Get_rank(), comm.Get_size()
        return ranks

    # Arrays of which every rank has some columns

    @property
    def exchange(self) -> int:
        """Address of the function that completes arrays, see `filters._share`; 0 for one rank."""
        return 0 if self._comm is None else self._exchange.address

    def check_exchange(self) -> None:
        """Raise what an exchange met: it is called by machine code, which knows no exceptions."""
        if self._comm is not None and self._exchange.error is not None:
            error, self._exchange.error = self._exchange.error, None
            raise error

    @cached_property
    def _exchange(self) -> Exchange:
        return Exchange(self._comm)


def communicator_of(comm: Any, *, in_lockstep: bool = True) -> Communicator:
    """The ranks of a communicator, all of which call this.

    Parameters
    ----------
    comm : None, "world", or mpi4py.MPI.Intracomm
        "world" are all ranks that mpiexec started, or this process alone without mpiexec.
    in_lockstep : bool
        Whether several ranks will evaluate one likelihood, for which they must be alike.

    Raises
    ------
    ModelError
        If it is something else.
    ParallelError
        If MPI cannot be had as it was asked for, or ranks in lockstep are not alike.

    Warns
    -----
    ParallelWarning
        If other ranks are not alike.
    """
    ranks = Communicator(communicator(comm))
    if ranks.size > 1:
        check_alike(ranks.allgather(describe_environment()), ranks.rank, in_lockstep=in_lockstep)
    return ranks


def describe_error(error: BaseException) -> str:
    """An error in one line: its type, its message and its notes."""
    notes = "; ".join(getattr(error, "__notes__", ()))
    return f"{type(error).__name__}: {error}" + (f" ({notes})" if notes else "")


_ARRAYS = 1  # tag; messages have 0


def _pieces(arrays: Sequence[np.ndarray]) -> "Sequence[memoryview]":
    pieces = []
    for array in arrays:
        view = memoryview(array).cast("B") if array.size else memoryview(b"")
        pieces += [view[i : i + _MOST_BYTES] for i in range(0, len(view), _MOST_BYTES)]
    return pieces
