"""Which rows the lanes of a group are at, going forward or back: they make the same steps.

A group takes as long as its longest record. A lane observes where its own record has a row; one
whose record has ended goes on without effect.
"""

import numpy as np

from ...compiler.native.jit import inline_always, njit_internal
from .group import BEGIN, N_ROWS, first_input_at, step_at
from .machine import STRETCH

NEVER = np.int64(2**62)
"""Later than any step."""

# Rows of integers of all lanes: the next row of the record in the table, the row behind its last,
# the step of its next row (`NEVER` behind the last), and the row of the inputs at step 0.
ROW, END, NEXT_STEP, FIRST_INPUT_ROW = range(4)
N_OF_LANE = 4


@inline_always
def n_stretches(n_steps):
    """The number of parts of so many steps up to a row; one if there are none."""
    return max(-(-n_steps // STRETCH), 1)


@njit_internal
def begin(lanes, records, rows):
    """Put every lane before the first row of its record; spare lanes have none."""
    for lane in range(lanes.shape[1]):
        record = min(lane, records.shape[0] - 1)
        row, n_rows = records[record, BEGIN], records[record, N_ROWS]
        lanes[ROW, lane], lanes[END, lane] = row, row + n_rows
        lanes[NEXT_STEP, lane] = step_at(rows, row) if lane == record and n_rows else NEVER
        lanes[FIRST_INPUT_ROW, lane] = first_input_at(rows, row) if n_rows else 0


@inline_always
def advance(lanes, lane, rows):
    """Go to the next row of a record."""
    row = lanes[ROW, lane] + 1
    lanes[ROW, lane] = row
    lanes[NEXT_STEP, lane] = step_at(rows, row) if row < lanes[END, lane] else NEVER


@njit_internal
def earliest(lanes):
    """The next step at which a record has a row, `NEVER` if none has."""
    step = NEVER
    for lane in range(lanes.shape[1]):
        step = min(step, lanes[NEXT_STEP, lane])
    return step


@njit_internal
def end(lanes, records, rows):
    """Put every lane at the last row of its record, to go back from there: see `retreat`."""
    begin(lanes, records, rows)
    for lane in range(lanes.shape[1]):
        row = lanes[END, lane] - 1
        is_used = lane < records.shape[0] and row >= lanes[ROW, lane]
        lanes[ROW, lane] = row
        lanes[NEXT_STEP, lane] = step_at(rows, row) if is_used else -1


@inline_always
def retreat(lanes, lane, records, rows):
    """Go back to the row before; ``next_step`` is then its step, -1 before the first."""
    row = lanes[ROW, lane] - 1
    lanes[ROW, lane] = row
    lanes[NEXT_STEP, lane] = step_at(rows, row) if row >= records[lane, BEGIN] else -1


@njit_internal
def latest(lanes):
    """The step of the last row that is left, -1 if none is."""
    step = np.int64(-1)
    for lane in range(lanes.shape[1]):
        step = max(step, lanes[NEXT_STEP, lane])
    return step


@njit_internal
def load_forces(machine, table, lanes, k, n_steps, forces):
    """Write the inputs of some steps; a record that has ended may have none left."""
    width, n, inputs = machine.width, machine.n_inputs, table.inputs
    if n == 0:
        return
    shared, last = True, inputs.shape[0] - 1
    for lane in range(width):
        shared &= lanes[FIRST_INPUT_ROW, lane] == lanes[FIRST_INPUT_ROW, 0]
    for step in range(n_steps):
        for i in range(n):
            row = forces[(step * n + i) * width :]
            if shared:
                value = inputs[min(lanes[FIRST_INPUT_ROW, 0] + k + step, last), i]
                for lane in range(width):
                    row[lane] = value
            else:
                for lane in range(width):
                    row[lane] = inputs[min(lanes[FIRST_INPUT_ROW, lane] + k + step, last), i]
