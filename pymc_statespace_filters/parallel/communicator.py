"""`Communicator`: collectives, messages and groups of MPI ranks, for the rest of the package.

Without MPI there is a single rank, and nothing is sent. Machine code calls an allgather of array
columns by its address.
"""

import ctypes
import sys
import time
from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import pairwise
from traceback import print_exception
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np

from ..errors import ParallelError
from .environment import check_environments, describe_environment
from .mpi import check_threads, mpi, mpi_communicator

_MAX_LAYOUTS = 256

# Intervals at which a waiting rank polls, from short to long: without pauses it takes a core.
_FIRST_POLL_SECONDS, _POLL_SECONDS = 0.00005, 0.005
# Time for the failed rank to report first, because the first rank to end may end the whole job.
ABORT_GRACE_SECONDS = 1.0
_MAX_BYTES = 2**28  # of one message
_ARRAYS = 1  # tag; messages have 0


class ColumnAllgather:
    """Gather the columns of arrays in machine code's memory, in place and on all ranks.

    Every rank has computed some of the columns, in whole blocks, as `filters.ensemble.reductions`
    divides them. ``address`` is that of a C function of an array's address, rows, columns and
    columns per block, and ``error`` its exception, which machine code cannot raise. After it the
    function does nothing.
    """

    def __init__(self, comm: Any):
        self._comm = comm
        self._rank, self._size = comm.Get_rank(), comm.Get_size()
        self._layouts: dict[tuple, tuple] = {}
        self.error: BaseException | None = None
        signature = ctypes.CFUNCTYPE(
            None, ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_ssize_t, ctypes.c_ssize_t
        )
        self._callback = signature(self._call)
        self.address: int = ctypes.cast(self._callback, ctypes.c_void_p).value or 0

    def _call(self, address: int, rows: int, columns: int, per_block: int) -> None:
        if self.error is not None:
            return
        try:
            self._allgather(address, rows, columns, per_block)
        except BaseException as error:
            self.error = error

    def _allgather(self, *key: int) -> None:
        if key not in self._layouts:
            if len(self._layouts) >= _MAX_LAYOUTS:
                self._layouts.clear()
            self._layouts[key] = self._layout(*key)
        array, ends, counts, starts, buffer = self._layouts[key]
        if buffer is None:
            self._comm.Allgatherv(mpi().IN_PLACE, [array, counts, starts, mpi().DOUBLE])
            return
        local = np.ascontiguousarray(array[:, ends[self._rank] : ends[self._rank + 1]])
        self._comm.Allgatherv(local, [buffer, counts, starts, mpi().DOUBLE])
        for r in range(self._size):
            if r != self._rank:
                part = buffer[starts[r] : starts[r] + counts[r]]
                array[:, ends[r] : ends[r + 1]] = part.reshape(len(array), -1)

    def _layout(self, address: int, rows: int, columns: int, per_block: int) -> tuple:
        memory = (ctypes.c_double * (rows * columns)).from_address(address)
        array = np.frombuffer(memory, np.float64).reshape(rows, columns)
        # The division of `filters.ensemble.reductions`.
        blocks = -(-columns // per_block)
        ends = [min(per_block * (blocks * r // self._size), columns) for r in range(self._size + 1)]
        counts = [rows * (last - first) for first, last in pairwise(ends)]
        starts = [rows * first for first in ends[:-1]]
        return array, ends, counts, starts, None if rows == 1 else np.empty(rows * columns)


Result = TypeVar("Result")


class Message(NamedTuple):
    """A message from another rank."""

    source: int
    kind: str
    value: Any


class Communicator:
    """A group of MPI ranks, as seen from one of them; a context manager.

    Without a communicator of mpi4py it is this process alone.
    """

    def __init__(self, comm: Any = None):
        # A duplicate, so that our messages cannot be received by the user's code.
        self._comm: Any = None if comm is None or comm.Get_size() == 1 else comm.Dup()
        self.rank: int = 0 if self._comm is None else self._comm.Get_rank()
        self.size: int = 1 if self._comm is None else self._comm.Get_size()
        self._sent: list[Any] = []
        self._known: BaseException | None = None  # the last error that all ranks have been told of

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # Freeing is collective, and after an error the other ranks may never get here.
        if kind is None:
            self.close()

    def close(self) -> None:
        """Free the communicator, on all ranks."""
        if self._comm is not None:
            for request in self._sent:
                request.wait()
            self._comm.Free()
            self._comm = None

    # Collectives

    def barrier(self) -> None:
        """Wait for all ranks without keeping a core busy."""
        if self._comm is not None:
            _wait([self._comm.Ibarrier()])

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

    def run_collectively(self, function: Callable[[], Result], mark: int = 0) -> Result:
        """Call a function on every rank, and give its result here; if one raises, all do.

        ``mark`` says what the function does, the same on all ranks. Raises what the function raised
        here; `ParallelError` if it raised on another rank, which the message names, or if the marks
        differ.
        """
        try:
            result, failure = function(), None
        except BaseException as error:  # an interrupt too: the others are waiting
            if self._is_known(error):
                raise
            failure = error
        report = None if failure is None else describe_error(failure)
        reports, marks = zip(*self.allgather((report, mark)), strict=True)
        failed = [rank for rank, report in enumerate(reports) if report is not None]
        differing = [rank for rank, one in enumerate(marks) if one != marks[0]]
        if not (failed or differing):
            return result
        if failed and self.rank != failed[0]:
            time.sleep(ABORT_GRACE_SECONDS)
        self._known = self._failure(failure, failed, differing, reports)
        raise self._known

    def _is_known(self, error: BaseException | None) -> bool:
        """Whether all ranks know of an error, or of one that it has come from."""
        while error is not None and error is not self._known:
            error = error.__cause__ or error.__context__
        return error is not None

    def _failure(
        self,
        failure: BaseException | None,
        failed: Sequence[int],
        differing: Sequence[int],
        reports: Sequence[str | None],
    ) -> BaseException:
        """What this rank raises where one has failed, or marks differ."""
        if failure is not None:
            if self._comm is not None:
                failure.add_note(f"on rank {self.rank} of {self.size}")
            return failure
        if failed:
            return ParallelError(
                f"rank {failed[0]} of {self.size} has stopped the run: {reports[failed[0]]}"
            )
        return ParallelError(
            f"rank {differing[0]} of {self.size} and rank 0 have computed different numbers: all "
            "ranks must make the same call, with the same data, random_seed and software"
        )

    def share_rows(self, arrays: Sequence[np.ndarray], parts: Sequence[tuple[int, int]]) -> None:
        """Fill in the rows of contiguous arrays that other ranks have, from first to last row."""
        if self._comm is not None:
            _wait(
                [
                    self._comm.Ibcast(piece, rank)
                    for rank, (first, last) in enumerate(parts)
                    for piece in _pieces([array[first:last] for array in arrays])
                ]
            )

    # Messages between two ranks

    def send(self, to: int, kind: str, value: Any = None) -> None:
        """Send a message without waiting for its receipt."""
        self._sent = [request for request in self._sent if not request.Test()]
        self._sent.append(self._comm.isend((kind, value), to))

    def send_to_others(self, kind: str, value: Any = None) -> None:
        """Send a message to every other rank."""
        for rank in range(self.size):
            if rank != self.rank:
                self.send(rank, kind, value)

    def receive(self) -> Message | None:
        """Receive the next message, if there is one."""
        if self._comm is None:
            return None
        status = mpi().Status()
        found = self._comm.improbe(status=status)
        return None if found is None else Message(status.source, *found.recv())

    def send_arrays(self, to: int, arrays: Sequence[np.ndarray]) -> None:
        """Send contiguous arrays, and wait for their receipt."""
        for piece in _pieces(arrays):
            self._comm.Send(piece, to, _ARRAYS)

    def receive_arrays(self, source: int, arrays: Sequence[np.ndarray]) -> None:
        """Receive arrays from a rank into contiguous ones."""
        for piece in _pieces(arrays):
            self._comm.Recv(piece, source, _ARRAYS)

    def abort(self, error: BaseException) -> None:
        """Print the error and end the whole job, in which other ranks wait for this one."""
        print_exception(error)
        sys.stderr.flush()
        mpi().COMM_WORLD.Abort(1)

    # Groups

    def groups(self, size: int) -> "tuple[Communicator, Communicator | None]":
        """Divide the ranks into groups of consecutive ones.

        Returns the group of this rank, and the first ranks of all groups (None on other ranks).
        """
        if self._comm is None or size == 1:
            return Communicator(), Communicator(self._comm)
        self.run_collectively(check_threads)
        group = Communicator._wrapping(self._comm.Split(self.rank // size, self.rank))
        leads = self.rank % size == 0
        leaders = self._comm.Split(0 if leads else mpi().UNDEFINED, self.rank)
        return group, Communicator._wrapping(leaders) if leads else None

    def node_local(self, value: Any = None) -> tuple[int, list[Any]]:
        """Rank among those on this computer, and the values of all of them."""
        if self._comm is None:
            return 0, [value]
        local = self._comm.Split_type(mpi().COMM_TYPE_SHARED)
        rank, values = local.Get_rank(), local.allgather(value)
        local.Free()
        return rank, values

    @classmethod
    def _wrapping(cls, comm: Any) -> "Communicator":
        """Wrap a communicator without duplicating it."""
        wrapper = cls()
        wrapper._comm, wrapper.rank, wrapper.size = comm, comm.Get_rank(), comm.Get_size()
        return wrapper

    # Allgather of array columns by machine code

    @property
    def exchange(self) -> int:
        """Address of the function that gathers the columns of an array; 0 for one rank."""
        return 0 if self._comm is None else self._column_allgather.address

    def check_exchange(self) -> None:
        """Raise the exception of that function, which machine code cannot raise."""
        if self._comm is not None and self._column_allgather.error is not None:
            error, self._column_allgather.error = self._column_allgather.error, None
            raise error

    @cached_property
    def _column_allgather(self) -> ColumnAllgather:
        return ColumnAllgather(self._comm)


def communicator_of(comm: Any, *, in_lockstep: bool = True) -> Communicator:
    """Make a `Communicator` of the argument ``comm``, on all its ranks.

    "world" is all ranks that mpiexec started, or this process alone without mpiexec. Ranks in
    lockstep will evaluate one likelihood, so that their environments must be equal; those of others
    are warned of. Raises `ModelError` if it is something else; `ParallelError` if MPI is not
    available, or the environments of ranks in lockstep differ.
    """
    communicator = Communicator(mpi_communicator(comm))
    if communicator.size > 1:
        environments = communicator.allgather(describe_environment())
        check_environments(environments, communicator.rank, in_lockstep=in_lockstep)
    return communicator


def describe_error(error: BaseException) -> str:
    """Describe an error in one line: type, message and notes."""
    notes = "; ".join(getattr(error, "__notes__", ()))
    return f"{type(error).__name__}: {error}" + (f" ({notes})" if notes else "")


def _wait(requests: list[Any]) -> None:
    """Wait until all are complete, without keeping a core busy."""
    pause = _FIRST_POLL_SECONDS
    while not mpi().Request.Testall(requests):
        time.sleep(pause)
        pause = min(1.5 * pause, _POLL_SECONDS)


def _pieces(arrays: Sequence[np.ndarray]) -> "Sequence[memoryview]":
    pieces = []
    for array in arrays:
        view = memoryview(array).cast("B") if array.size else memoryview(b"")
        pieces += [view[i : i + _MAX_BYTES] for i in range(0, len(view), _MAX_BYTES)]
    return pieces
