"""The exchange of arrays of which every rank has some columns, called by machine code."""

import ctypes
from itertools import pairwise
from typing import Any

import numpy as np

from pymc_statespace_filters.parallel.mpi import mpi

_MOST_KNOWN_ARRAYS = 256


class Exchange:
    """Complete the columns of arrays in machine code's memory, on all ranks.

    Attributes
    ----------
    address : int
        Of a function of an array's address, rows, columns and columns of a block, see
        `filters._share`.
    error : BaseException or None
        What was met: machine code knows no exceptions. Nothing is exchanged after it.
    """

    def __init__(self, comm: Any):
        self._comm = comm
        self._rank, self._size = comm.Get_rank(), comm.Get_size()
        self._known: dict[tuple, tuple] = {}
        self.error: BaseException | None = None
        signature = ctypes.CFUNCTYPE(
            None, ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_ssize_t, ctypes.c_ssize_t
        )
        self._callback = signature(self._called)
        self.address: int = ctypes.cast(self._callback, ctypes.c_void_p).value or 0

    def _called(self, address: int, rows: int, columns: int, per_block: int) -> None:
        if self.error is not None:
            return
        try:
            self._complete(address, rows, columns, per_block)
        except BaseException as error:
            self.error = error

    def _complete(self, *what: Any) -> None:
        if what not in self._known:
            if len(self._known) >= _MOST_KNOWN_ARRAYS:
                self._known.clear()
            self._known[what] = self._learn(*what)
        array, ends, counts, starts, buffer = self._known[what]
        if buffer is None:
            self._comm.Allgatherv(mpi().IN_PLACE, [array, counts, starts, mpi().DOUBLE])
            return
        own = np.ascontiguousarray(array[:, ends[self._rank] : ends[self._rank + 1]])
        self._comm.Allgatherv(own, [buffer, counts, starts, mpi().DOUBLE])
        for r in range(self._size):
            if r != self._rank:
                part = buffer[starts[r] : starts[r] + counts[r]]
                array[:, ends[r] : ends[r + 1]] = part.reshape(len(array), -1)

    def _learn(self, address: int, rows: int, columns: int, per_block: int) -> tuple:
        memory = (ctypes.c_double * (rows * columns)).from_address(address)
        array = np.frombuffer(memory, np.float64).reshape(rows, columns)
        # The division of `filters._share.part`.
        blocks = -(-columns // per_block)
        ends = [min(per_block * (blocks * r // self._size), columns) for r in range(self._size + 1)]
        counts = [rows * (last - first) for first, last in pairwise(ends)]
        starts = [rows * first for first in ends[:-1]]
        return array, ends, counts, starts, None if rows == 1 else np.empty(rows * columns)
