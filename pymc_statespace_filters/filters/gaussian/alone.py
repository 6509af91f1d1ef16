"""One record after the other: how a pass takes a record forward and back.

The tape has all its states: before each step and before each row. The loops are the system's, with
the state in registers.
"""

import numpy as np

from ...compiler.native.jit import njit_internal
from .failures import failure_along
from .group import BEGIN, N_ROWS, POINT, SHIFT, Way, call_along, copy, step_at


@njit_internal
def _in_turn(records, rows):
    """The records in the order in which they are taken."""
    return records


@njit_internal
def n_states_on_tape(machine, rows, records):
    """The number of states on a tape: one for each step and row, and the last one."""
    total = np.int64(1)
    for i in range(records.shape[0]):
        n = records[i, N_ROWS]
        total += n + (step_at(rows, records[i, BEGIN] + n - 1) if n else 0)
    return total


@njit_internal
def forward_along(machine, work, table, records, alive, tape, terms, health):
    """Go along a record to its last state; return how many numbers are on the tape."""
    m, record, states, stride = machine, records[0], work.states, np.int64(0)
    if tape.size > 0:
        copy(states, tape[: m.size])
        states, stride = tape, np.int64(m.size)
    j = call_along(m.along, m, work.W, table, record, states, stride, terms)
    n_rows, point = record[N_ROWS], record[POINT]
    last = min(j, n_rows - 1)
    k = step_at(table.rows, record[BEGIN] + last) if n_rows else table.first
    place = stride * (j + k - table.first)
    if j == n_rows:
        copy(states[place:], work.states[: m.size])
        return place
    row, at = record[BEGIN] + j, record[SHIFT] + record[BEGIN] + j
    health[point, 1] = failure_along(m, work.W, table, row, states[place:], terms[at])
    health[point, 2], terms[at] = row, -np.inf
    return place + stride


@njit_internal
def _backward(machine, work, table, records, tape, place, terms_bar):
    """Go back along a record, from a place of the tape; return the next."""
    m, record, n_rows = machine, records[0], records[0, N_ROWS]
    if n_rows:
        place -= (step_at(table.rows, record[BEGIN] + n_rows - 1) + n_rows) * m.size
        stride = np.int64(m.size)
        call_along(m.along_back, m, work.W, table, record, tape[place:], stride, terms_bar)
    return place


ALONE = Way("alone", _in_turn, n_states_on_tape, forward_along, _backward)
