"""The backward pass along the tape of the forward pass, compiled once for all systems."""

import numpy as np

from ...compiler.native.entry_point import call_address
from ...compiler.native.jit import njit_internal
from ...compiler.native.plan import HEALTH_SIZE, RECORD, REQUEST, RESULTS, plan_entry
from ..calls import OK, opened, reals_at
from ..outcomes import NONE, is_missing
from ..plan import PLAN, settings_of
from .forward import forward_pass
from .group import (
    END,
    N_OF_LANE,
    N_ROWS,
    NEXT_STEP,
    POINT,
    ROW,
    SHIFT,
    call_along,
    copy,
    end,
    latest,
    load_forces,
    load_parameters,
    n_states_on_tape,
    n_stretches,
    parameters_of,
    records_of,
    retreat,
    set_all,
    table_of,
)
from .machine import STRETCH, call, n_lanes_of, read_machine, rows_at, workspace


@njit_internal
def backward_pass(machine, table, records, tape, terms_bar, theta_bar):
    """Write the cotangents of all parameters."""
    m, work, place = machine, workspace(machine), tape.size
    W, n_records, t0 = work.W, records.shape[0], table.t0
    c_bar = rows_at(m, W, m.rows.c_bar, m.n_theta)
    lanes = np.empty((N_OF_LANE, m.width), np.int64)
    for first in range(m.width * ((n_records - 1) // m.width), -1, -m.width):
        group = records[first : min(first + m.width, n_records)]
        n_lanes = n_lanes_of(m, group)
        load_parameters(m, table, group, W)
        end(lanes, group, table.rows)
        call(m.start, m, n_lanes, work, work.states, work.forces, t0, 0, 1)
        call(m.prepare_back, m, n_lanes, work, work.states, work.forces, t0, 0, 1)
        if m.along_back == 0:
            place = _side_by_side(m, work, table, group, lanes, tape, place, terms_bar)
        elif group[0, N_ROWS]:
            place -= (lanes[NEXT_STEP, 0] + group[0, N_ROWS]) * m.size
            stride = np.int64(m.size)
            call_along(m.along_back, m, W, table, group[0], tape[place:], stride, terms_bar)
        call(m.finish_back, m, n_lanes, work, work.states, work.forces, t0, 0, 1)
        for lane in range(group.shape[0]):
            for i in range(m.n_theta):
                theta_bar[group[lane, POINT], i] = c_bar[i * m.width + lane]


@njit_internal
def _side_by_side(machine, work, table, records, lanes, tape, place, terms_bar):
    """Go back along the records of a group in lanes, from a place of the tape; return the next."""
    m, states, n_lanes = machine, work.states, n_lanes_of(machine, records)
    size, t0, k = m.size * m.width, table.t0, latest(lanes)
    while k >= 0:
        any_seen = _observe(m, work.W, lanes, records, table, terms_bar, k)
        step, row = latest(lanes), k
        origin = max(step, 0)
        for number in range(n_stretches(row - origin) - 1, -1, -1):
            start = origin + number * STRETCH
            n_steps = k - start
            place -= size
            copy(tape[place:], states[:size])
            load_forces(m, table, lanes, start, n_steps + 1, work.forces)
            call(m.predict, m, n_lanes, work, states, work.forces, t0, start, n_steps)
            if any_seen and k == row:
                last = states[n_steps * size :]
                force = work.forces[n_steps * m.n_inputs * m.width :]
                call(m.update_back, m, n_lanes, work, last, force, t0, k, 1)
            call(m.predict_back, m, n_lanes, work, states, work.forces, t0, start, n_steps)
            k = start
        k = step
    return place


@njit_internal
def _observe(machine, W, lanes, records, table, terms_bar, k):
    """Load the rows of step k. The cotangents of a record are zero until its last row."""
    m, any_seen = machine, False
    d, seen = rows_at(m, W, m.rows.d, m.p), rows_at(m, W, m.rows.seen, 1)
    s_bar, c_bar = rows_at(m, W, m.rows.s_bar, m.size), rows_at(m, W, m.rows.c_bar, m.n_theta)
    term_bar = rows_at(m, W, m.rows.term, 1)
    for lane in range(m.width):
        seen[lane] = 0.0
    for lane in range(records.shape[0]):
        if lanes[NEXT_STEP, lane] != k:
            continue
        j = lanes[ROW, lane]
        retreat(lanes, lane, records, table.rows)
        if j + 1 == lanes[END, lane]:
            for i in range(lane, s_bar.size, m.width):
                s_bar[i] = 0.0
            for i in range(lane, c_bar.size, m.width):
                c_bar[i] = 0.0
        if is_missing(table.observed, j):
            continue
        any_seen, seen[lane] = True, 1.0
        term_bar[lane] = terms_bar[records[lane, SHIFT] + j]
        for i in range(m.p):
            d[i * m.width + lane] = table.observed[j, i]
    return any_seen


@njit_internal
def _tape_of(call, machine, table, records):
    """The tape that a call brings, or that of a forward pass; empty if this fails."""
    request, n_rows = call.request, call.record[RECORD.n_rows]
    if not call.plan[PLAN.leaves_tape]:
        return reals_at(
            request[REQUEST.tape], (request[REQUEST.n_tape] * request[REQUEST.tape_width],)
        )
    n_states, size = n_states_on_tape(call, machine, records), machine.size * machine.width
    tape, n_records = np.empty(n_states * size), table.theta.shape[0]
    terms, health = np.empty(n_rows * n_records), np.empty((n_records, HEALTH_SIZE))
    n_taped = forward_pass(
        machine, settings_of(call.plan), table, records, tape, terms, health, np.empty((0, 0))
    )
    for record in range(n_records):
        if health[record, 1] != NONE:
            return tape[:0]
    return tape[:n_taped]


def _backward(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    if status != OK or call.request[REQUEST.sizes_only]:
        return status
    machine, given = read_machine(call.plan), call.record
    n_records, n_theta = given[RECORD.n_records], given[RECORD.n_theta]
    theta_bar = reals_at(call.results[RESULTS.theta_bar], (n_records, n_theta))
    set_all(theta_bar.reshape(theta_bar.size), 0.0)
    table = table_of(call, parameters_of(call), np.empty((0, 0)), np.empty(0))
    records = records_of(call, machine)
    tape = _tape_of(call, machine, table, records)
    if tape.size == 0:
        return OK
    terms_bar = reals_at(call.request[REQUEST.terms_bar], (call.request[REQUEST.n_terms_bar],))
    if call.plan[PLAN.extend_back] == 0:
        backward_pass(machine, table, records, tape, terms_bar, theta_bar)
        return OK
    extended_bar = np.zeros((n_records, machine.n_theta))
    backward_pass(machine, table, records, tape, terms_bar, extended_bar)
    theta = reals_at(given[RECORD.theta], (n_records, n_theta))
    both = np.empty(n_theta + machine.n_theta)
    for i in range(n_records):
        # Zero where there is nothing to pull back, as after a failure: its constant may be NaN.
        if extended_bar[i].any():
            copy(theta[i], both[:n_theta])
            copy(extended_bar[i], both[n_theta:])
            call_address(call.plan[PLAN.extend_back], (both, np.int64(both.size), theta_bar[i]))
    return OK


BACKWARD = plan_entry(_backward, "gaussian_backward")
