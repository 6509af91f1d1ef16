"""The records of a call: where their rows and terms are, their parameters and inputs.

Records are described by an array (G, 4) with the columns below. As many of them as there are lanes
are a group, a record that goes alone is a group of one lane. The points of a single record are
records that share rows.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...compiler.codegen.arguments import AlongArguments
from ...compiler.native.entry_point import call_address
from ...compiler.native.jit import inline_always, njit_internal
from ...compiler.native.plan import RECORD, REQUEST, RESULTS, STATE
from ...system import panel_records as panel
from ..calls import OK, integers_at, reals_at
from ..outcomes import NONE
from ..plan import PLAN

# Columns of the records: the row of theta, the first row of the table and the number of rows, and
# what leads from a row to its term.
POINT, BEGIN, N_ROWS, SHIFT = range(4)
N_OF_RECORD = 4


class Way(NamedTuple):
    """How a pass takes records: its name, their order, the states on their tape, and a group.

    ``order(records, rows)`` are the records in another order, ``n_states(machine, rows, records)``
    is a number. ``forward(machine, work, table, records, alive, tape, terms, health)`` takes the
    records of a group that are alive to their ends; it returns how many numbers are on the tape.
    ``backward(machine, work, table, records, tape, place, terms_bar)`` takes them back from a place
    of the tape and returns the next.
    """

    name: str
    order: Callable
    n_states: Callable
    forward: Callable
    backward: Callable


class Table(NamedTuple):
    """The rows of all records, which are steps or as in `system.record`; data, inputs, noises.

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
def rows_of(call):
    """The rows of a call, for each step or as in `system.panel`."""
    given = call.record
    n_rows, width = given[RECORD.n_rows], given[RECORD.row_width]
    return integers_at(given[RECORD.rows], n_rows * width).reshape((n_rows, width))


@njit_internal
def table_of(call, theta, noises, x):
    """The table of a call."""
    given, before = call.record, _states_given(call)
    n_rows, n_inputs = given[RECORD.n_rows], given[RECORD.n_inputs]
    return Table(
        rows=rows_of(call),
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
def records_of(call):
    """The records of a call, in their own order."""
    rows, n_records = rows_of(call), call.record[RECORD.n_records]
    n_rows, width = rows.shape
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
    return found
