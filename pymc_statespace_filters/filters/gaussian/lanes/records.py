"""The records of one evaluation: where their rows and terms are, and in which order they come.

Records are described by an array (G, 4) with the columns below. `LANES` of them at a time are a
group, whose lanes go through the same steps; a group takes as long as its longest record.
"""

import numpy as np
from numba import carray, types

from pymc_statespace_filters.compiler.codegen.simd import LANES
from pymc_statespace_filters.compiler.native.entry_point import (
    I64_PTR,
    EntryPoint,
    address_of,
    arguments_class,
    call_address,
)
from pymc_statespace_filters.compiler.native.jit import njit_internal
from pymc_statespace_filters.filters.gaussian.lanes.group import (
    BEGIN,
    N_OF_LANE,
    N_OF_RECORD,
    N_ROWS,
    NEVER,
    NEXT_STEP,
    POINT,
    SHIFT,
    advance,
    begin,
    earliest,
    n_stretches,
)
from pymc_statespace_filters.system.panel import N_COLUMNS, RECORD, STEP

_ARGUMENTS = {
    "rows": I64_PTR, "n_rows": types.intp, "records": I64_PTR, "n_records": types.intp,
    "places": I64_PTR, "n_states": I64_PTR,
}  # fmt: skip

_Arguments = arguments_class("_Arguments", _ARGUMENTS, __name__)


def _find(rows, n_rows, records, n_records, places, n_states):
    """Find the records, and count the states on the tape of their evaluation if there is one."""
    table, found = carray(rows, (n_rows, N_COLUMNS)), np.empty((n_records, N_OF_RECORD), np.int64)
    last = np.empty(n_records, np.int64)
    record = -1
    for j in range(n_rows):
        if j == 0 or table[j, RECORD] != table[j - 1, RECORD]:
            record += 1
            found[record, POINT], found[record, BEGIN] = record, j
            found[record, N_ROWS] = found[record, SHIFT] = 0
        found[record, N_ROWS] += 1
        last[record] = -table[j, STEP]
    order = np.argsort(last, kind="mergesort")
    sorted = carray(records, (n_records, N_OF_RECORD))
    for i in range(n_records):
        for column in range(N_OF_RECORD):
            sorted[i, column] = found[order[i], column]
    lanes, counted = carray(places, (N_OF_LANE, LANES)), carray(n_states, (1,))
    if counted[0]:
        counted[0] = _count_states(table, sorted, lanes)


@njit_internal
def _count_states(rows, records, lanes):
    total = 0
    for first in range(0, records.shape[0], LANES):
        group = records[first : min(first + LANES, records.shape[0])]
        begin(lanes, group, rows)
        last, step = np.int64(0), earliest(lanes)
        while step != NEVER:
            total += n_stretches(step - last)
            last = step
            for lane in range(group.shape[0]):
                if lanes[NEXT_STEP, lane] == step:
                    advance(lanes, lane, rows)
            step = earliest(lanes)
    return total


FIND_RECORDS = EntryPoint(_find, _ARGUMENTS, "find_records")
"""Find the records of a panel, compiled once for all systems."""

_FIND = FIND_RECORDS.symbol


@njit_internal
def records_of(rows, n_records, taped):
    """The records of a panel, the longest first, and the number of states on a tape if taped."""
    records, n_states = np.empty((n_records, N_OF_RECORD), np.int64), np.empty(1, np.int64)
    places, n_states[0] = np.empty((N_OF_LANE, LANES), np.int64), taped
    arguments = _Arguments(
        rows=rows, n_rows=rows.shape[0], records=records, n_records=n_records, places=places,
        n_states=n_states,
    )  # fmt: skip
    call_address(address_of(_FIND), arguments)
    return records, n_states[0]
