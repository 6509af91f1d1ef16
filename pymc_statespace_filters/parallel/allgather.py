"""An allgather of array columns that machine code calls."""

import ctypes
from itertools import pairwise
from typing import Any

import numpy as np

from .mpi import mpi

_MAX_LAYOUTS = 256


class ColumnAllgather:
    """Gather the columns of arrays in machine code's memory, in place and on all ranks.

    Every rank has computed some of the columns, in whole blocks, as `filters.ensemble.partition`
    divides them.

    Attributes
    ----------
    address : int
        Address of a C function of an array's address, rows, columns and columns per block.
    error : BaseException or None
        Exception of the function, which machine code cannot raise. After it the function does
        nothing.
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
        # The division of `filters.ensemble.partition`.
        blocks = -(-columns // per_block)
        ends = [min(per_block * (blocks * r // self._size), columns) for r in range(self._size + 1)]
        counts = [rows * (last - first) for first, last in pairwise(ends)]
        starts = [rows * first for first in ends[:-1]]
        return array, ends, counts, starts, None if rows == 1 else np.empty(rows * columns)
