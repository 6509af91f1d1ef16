"""The records of one group in lanes: their rows, parameters and inputs, and calls for all of them.

All lanes go through the same steps. A lane observes where its own record has a row; one whose
record has ended goes on without effect. All arrays are at addresses that the caller keeps, so that
no references to them are counted.
"""

import numpy as np
from numba import carray

from pymc_statespace_filters.compiler.codegen.simd import LANES, LANES_AT_ONCE, LaneArguments
from pymc_statespace_filters.compiler.native.entry_point import call_address
from pymc_statespace_filters.compiler.native.jit import inline_always, njit_internal
from pymc_statespace_filters.system.panel import FIRST_INPUT, STEP

# Columns of the records: the row of theta, the first row of the table and the number of rows, and
# what leads from a row to its term.
POINT, BEGIN, N_ROWS, SHIFT = range(4)
N_OF_RECORD = 4

STRETCH = 32  # steps; their states fit into the processor's cache

NEVER = np.int64(2**62)
"""Later than any step."""


# Rows of integers of all lanes: the next row of the record in the table, the row behind its last,
# the step of its next row (`NEVER` behind the last), the row of the inputs at step 0, and whether
# the record has not failed.
ROW, END, NEXT_STEP, FIRST_INPUT_ROW, ALIVE = range(5)
N_OF_LANE = 5


@inline_always
def n_stretches(n_steps):
    """The number of parts of so many steps up to a row; one if there are none."""
    return max(-(-n_steps // STRETCH), 1)


@njit_internal
def begin(lanes, records, rows):
    """Put every lane before the first row of its record; spare lanes have none."""
    for lane in range(LANES):
        record = min(lane, records.shape[0] - 1)
        row, n_rows = records[record, BEGIN], records[record, N_ROWS]
        lanes[ROW, lane], lanes[END, lane] = row, row + n_rows
        lanes[NEXT_STEP, lane] = rows[row, STEP] if lane == record and n_rows else NEVER
        lanes[FIRST_INPUT_ROW, lane] = rows[row, FIRST_INPUT] if n_rows else 0


@inline_always
def advance(lanes, lane, rows):
    """Go to the next row of a record."""
    row = lanes[ROW, lane] + 1
    lanes[ROW, lane] = row
    lanes[NEXT_STEP, lane] = rows[row, STEP] if row < lanes[END, lane] else NEVER


@njit_internal
def earliest(lanes):
    """The next step at which a record has a row, `NEVER` if none has."""
    step = NEVER
    for lane in range(LANES):
        step = min(step, lanes[NEXT_STEP, lane])
    return step


@njit_internal
def end(lanes, records, rows):
    """Put every lane at the last row of its record, to go back from there: see `retreat`."""
    begin(lanes, records, rows)
    for lane in range(LANES):
        row = lanes[END, lane] - 1
        lanes[ROW, lane] = row
        lanes[NEXT_STEP, lane] = rows[row, STEP] if lane < records.shape[0] else -1


@inline_always
def retreat(lanes, lane, records, rows):
    """Go back to the row before; ``next_step`` is then its step, -1 before the first."""
    row = lanes[ROW, lane] - 1
    lanes[ROW, lane] = row
    lanes[NEXT_STEP, lane] = rows[row, STEP] if row >= records[lane, BEGIN] else -1


@njit_internal
def latest(lanes):
    """The step of the last row that is left, -1 if none is."""
    step = np.int64(-1)
    for lane in range(LANES):
        step = max(step, lanes[NEXT_STEP, lane])
    return step


@njit_internal
def load_parameters(n_theta, theta, records, W):
    """Write the parameters of the records to lanes; spare lanes repeat the last record."""
    for lane in range(LANES):
        point = records[min(lane, records.shape[0] - 1), POINT]
        for i in range(n_theta):
            W[i * LANES + lane] = theta[point, i]


@njit_internal
def load_inputs(inputs, lanes, k, n_steps, forces):
    """Write the inputs of some steps; a record that has ended may have none left."""
    last, n = inputs.shape[0] - 1, inputs.shape[1]
    if n == 0:
        return
    shared = True
    for lane in range(LANES):
        shared &= lanes[FIRST_INPUT_ROW, lane] == lanes[FIRST_INPUT_ROW, 0]
    for step in range(n_steps):
        for i in range(n):
            row = forces[(step * n + i) * LANES :]
            if shared:
                value = inputs[min(lanes[FIRST_INPUT_ROW, 0] + k + step, last), i]
                for lane in range(LANES):
                    row[lane] = value
            else:
                for lane in range(LANES):
                    row[lane] = inputs[min(lanes[FIRST_INPUT_ROW, lane] + k + step, last), i]


@njit_internal
def copy(source, target):
    """Set all of a vector to the first elements of another one."""
    for i in range(target.size):
        target[i] = source[i]


@inline_always
def rows_of(W, first, n):
    """Some rows of lanes, without a copy."""
    return W[first * LANES : (first + n) * LANES]


@inline_always
def n_numbers(n_rows, state_size, n_inputs):
    """The length of what `workspace` divides."""
    return (n_rows + (STRETCH + 2) * state_size + (STRETCH + 1) * n_inputs) * LANES + 8


@njit_internal
def workspace(address, n_rows, state_size, n_inputs):
    """Rows of vectors, states of a stretch and of an update at its end, and their inputs.

    They begin at a multiple of 64 bytes, which a vector instruction reads at once.
    """
    whole = carray(address, (n_numbers(n_rows, state_size, n_inputs),))
    whole[:] = 0.0
    first = (-whole.ctypes.data % 64) // 8
    second = first + n_rows * LANES
    third = second + (STRETCH + 2) * state_size * LANES
    return whole[first:second], whole[second:third], whole[third:]


@njit_internal
def call(function, W, n_lanes, states, forces, t0, dt, k, n_steps):
    """Call a function of a table from step k on, with states and inputs that begin there."""
    arguments = LaneArguments(
        W=W, n_lanes=n_lanes, states=states, forces=forces, t0=t0, dt=dt, k=k, n_steps=n_steps
    )
    call_address(function, arguments)


@njit_internal
def n_lanes_of(records):
    """The number of lanes that the records of a group take."""
    return -(-records.shape[0] // LANES_AT_ONCE) * LANES_AT_ONCE
