"""The records of a call: where their rows and terms are, their parameters and inputs.

Records are described by an array (G, 4) with the columns below. As many of them as there are lanes
are a group, and go through the same steps; a group takes as long as its longest record. A lane
observes where its own record has a row; one whose record has ended goes on without effect. A record
that goes alone is a group of one lane. The points of a single record are records that share rows.
"""

from typing import NamedTuple

import numpy as np

from ...compiler.codegen.arguments import AlongArguments
from ...compiler.native.entry_point import call_address
from ...compiler.native.jit import inline_always, njit_internal
from ...compiler.native.plan import RECORD, REQUEST, RESULTS, STATE
from ...compiler.numerics.order import stable_order
from ...system import panel_records as panel
from ..calls import OK, integers_at, reals_at
from ..outcomes import NONE
from ..plan import PLAN
from .machine import STRETCH

# Columns of the records: the row of theta, the first row of the table and the number of rows, and
# what leads from a row to its term.
POINT, BEGIN, N_ROWS, SHIFT = range(4)
N_OF_RECORD = 4

NEVER = np.int64(2**62)
"""Later than any step."""

# Rows of integers of all lanes: the next row of the record in the table, the row behind its last,
# the step of its next row (`NEVER` behind the last), the row of the inputs at step 0, and whether
# the record has not failed.
ROW, END, NEXT_STEP, FIRST_INPUT_ROW, ALIVE = range(5)
N_OF_LANE = 5


class Table(NamedTuple):
    """The rows of all records, which are steps or as in `system.panel`; data, inputs, noises.

    ``theta`` are the parameters that the functions take. ``noises`` has a row for each step, and
    ``x`` is an error of the start, where states are drawn. A record that goes on from earlier rows
    begins at the step ``first``; each of its points does so with the state behind a step in
    ``before``, which is empty otherwise.
    """

    rows: np.ndarray
    theta: np.ndarray
    observed: np.ndarray
    inputs: np.ndarray
    noises: np.ndarray
    x: np.ndarray
    t0: float
    first: int
    before: np.ndarray


@njit_internal
def table_of(call, theta, noises, x):
    """The table of a call."""
    given, before = call.record, _states_given(call)
    n_rows, width = given[RECORD.n_rows], given[RECORD.row_width]
    n_inputs = given[RECORD.n_inputs]
    return Table(
        rows=integers_at(given[RECORD.rows], n_rows * width).reshape((n_rows, width)),
        theta=theta,
        observed=reals_at(given[RECORD.observed], (n_rows, given[RECORD.n_observables])),
        inputs=reals_at(given[RECORD.inputs], (given[RECORD.n_input_rows], n_inputs)),
        noises=noises,
        x=x,
        t0=reals_at(given[RECORD.starts], (given[RECORD.n_starts],))[0],
        first=int(before[0, 0]) if before.size else 0,
        before=before,
    )


@njit_internal
def _states_given(call):
    request = call.request
    return reals_at(request[REQUEST.state], (request[REQUEST.n_before], request[REQUEST.n_state]))


@njit_internal
def status_of_states(call, machine):
    """A status: whether each point goes on from a state, all at one step; writes their size."""
    before, size = _states_given(call), 1 + machine.size
    call.results[RESULTS.n_state] = size
    if before.size == 0:
        return OK
    if before.shape != (call.record[RECORD.n_records], size):
        return np.int64(STATE)
    for i in range(before.shape[0]):
        if before[i, 0] != before[0, 0]:
            return np.int64(STATE)
    return OK


@njit_internal
def states_wanted(call):
    """Where the states that the filter leaves at the points go; empty if they are not wanted."""
    to = call.results
    n_points = to[RESULTS.n_points] if to[RESULTS.state] != 0 else 0
    return reals_at(to[RESULTS.state], (n_points, to[RESULTS.n_state]))


@inline_always
def step_at(rows, j):
    """The step of a row."""
    return rows[j, panel.STEP if rows.shape[1] > 1 else 0]


@inline_always
def first_input_at(rows, j):
    """The row of the inputs that the record of a row has at its step 0."""
    return rows[j, panel.FIRST_INPUT] if rows.shape[1] > 1 else 0


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
def call_along(function, machine, W, table, record, states, stride, terms):
    """Call a function along a record; return how many of its rows it has done."""
    m, first, n_rows = machine, record[BEGIN], record[N_ROWS]
    width, p = table.rows.shape[1], m.p
    steps = table.rows.reshape(table.rows.size)
    step_column = panel.STEP if width > 1 else 0
    observed, inputs = table.observed, table.inputs
    first_input = first_input_at(table.rows, first) if n_rows else 0
    arguments = AlongArguments(
        W=W, steps=steps[first * width + step_column :], row_width=np.int64(width),
        n_rows=n_rows, first=np.int64(table.first),
        observed=observed.reshape(observed.size)[first * p :],
        inputs=inputs.reshape(inputs.size)[first_input * m.n_inputs :],
        noises=table.noises.reshape(table.noises.size), states=states, stride=stride, t0=table.t0,
        dt=m.dt, terms=terms[record[SHIFT] + first :],
    )  # fmt: skip
    call_address(function, arguments)
    return int(W[m.rows.term])


@njit_internal
def load_parameters(machine, table, records, W):
    """Write the parameters of the records to lanes; spare lanes repeat the last record."""
    for i in range(table.x.size):
        W[machine.rows.x + i] = table.x[i]
    for lane in range(machine.width):
        point = records[min(lane, records.shape[0] - 1), POINT]
        for i in range(machine.n_theta):
            W[i * machine.width + lane] = table.theta[point, i]


@njit_internal
def load_states(machine, table, records, states):
    """Write the states from which the records go on to lanes; spare lanes repeat the last."""
    for lane in range(machine.width):
        point = records[min(lane, records.shape[0] - 1), POINT]
        for i in range(machine.size):
            states[i * machine.width + lane] = table.before[point, 1 + i]


@njit_internal
def store_states(machine, table, records, states, health, after):
    """Write what the filter leaves at the points of a group that has not failed."""
    for lane in range(records.shape[0]):
        point, n_rows = records[lane, POINT], records[lane, N_ROWS]
        if health[point, 1] != NONE:
            continue
        last = step_at(table.rows, records[lane, BEGIN] + n_rows - 1) if n_rows else table.first
        after[point, 0] = last
        for i in range(machine.size):
            after[point, 1 + i] = states[i * machine.width + lane]


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


@njit_internal
def copy(source, target):
    """Set all of a vector to the first elements of another one."""
    for i in range(target.size):
        target[i] = source[i]


@njit_internal
def set_all(values, number):
    """Set all of a vector to a number."""
    for i in range(values.size):
        values[i] = number


@njit_internal
def parameters_of(call):
    """The parameters that the functions of a plan take, a row for each record."""
    given, plan = call.record, call.plan
    shape = (given[RECORD.n_records], given[RECORD.n_theta])
    theta = reals_at(given[RECORD.theta], shape)
    if plan[PLAN.extend] == 0:
        return theta
    extended = np.empty((shape[0], plan[PLAN.n_theta]))
    for i in range(shape[0]):
        call_address(plan[PLAN.extend], (theta[i], np.int64(shape[1]), extended[i]))
    return extended


@njit_internal
def records_of(call, machine):
    """The records of a call; in lanes, the longest come first."""
    given, n_records = call.record, call.record[RECORD.n_records]
    n_rows, width = given[RECORD.n_rows], given[RECORD.row_width]
    rows = integers_at(given[RECORD.rows], n_rows * width).reshape((n_rows, width))
    found = np.empty((n_records, N_OF_RECORD), np.int64)
    if width == 1:
        for i in range(n_records):
            found[i, POINT], found[i, BEGIN] = i, 0
            found[i, N_ROWS], found[i, SHIFT] = n_rows, i * n_rows
        return found
    record = -1
    for j in range(n_rows):
        if j == 0 or rows[j, panel.RECORD] != rows[j - 1, panel.RECORD]:
            record += 1
            found[record, POINT], found[record, BEGIN] = record, j
            found[record, N_ROWS] = found[record, SHIFT] = 0
        found[record, N_ROWS] += 1
    if machine.width == 1:
        return found
    last = np.empty(n_records, np.int64)
    for i in range(n_records):
        last[i] = -rows[found[i, BEGIN] + found[i, N_ROWS] - 1, panel.STEP]
    order = stable_order(last)
    sorted = np.empty((n_records, N_OF_RECORD), np.int64)
    for i in range(n_records):
        for column in range(N_OF_RECORD):
            sorted[i, column] = found[order[i], column]
    return sorted


@njit_internal
def n_states_on_tape(call, machine, records):
    """The number of states on a tape, one for each lane, and one more for a record alone."""
    given = call.record
    n_rows, width = given[RECORD.n_rows], given[RECORD.row_width]
    rows = integers_at(given[RECORD.rows], n_rows * width).reshape((n_rows, width))
    total = np.int64(0)
    if machine.width == 1:
        for i in range(records.shape[0]):
            n = records[i, N_ROWS]
            total += n + (step_at(rows, records[i, BEGIN] + n - 1) if n else 0)
        return total + 1
    lanes = np.empty((N_OF_LANE, machine.width), np.int64)
    for first in range(0, records.shape[0], machine.width):
        group = records[first : min(first + machine.width, records.shape[0])]
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
