"""The forward pass along records, compiled once for all systems.

In lanes, the tape has a state of each group at its rows, and at least every `STRETCH` steps. The
way back makes the steps between them again, which takes less time than to read all states from
memory. The tape of a record alone has all states: before each step and before each row.
"""

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.native.plan import HEALTH_SIZE, RECORD, REQUEST, RESULTS, plan_entry
from ...compiler.numerics.small_cholesky import covariance_root
from ..calls import OK, opened, reals_at
from ..outcomes import NONE, OUT_OF_MEMORY, is_missing
from ..plan import PLAN, settings_of
from .failures import failure_along, failure_in_lane
from .group import (
    ALIVE,
    BEGIN,
    N_OF_LANE,
    N_ROWS,
    NEVER,
    NEXT_STEP,
    POINT,
    ROW,
    SHIFT,
    advance,
    begin,
    call_along,
    copy,
    earliest,
    load_forces,
    load_parameters,
    load_states,
    n_states_on_tape,
    n_stretches,
    parameters_of,
    records_of,
    set_all,
    states_wanted,
    status_of_states,
    step_at,
    store_states,
    table_of,
)
from .machine import STRETCH, call, n_lanes_of, read_machine, rows_at, workspace


@njit_internal
def forward_pass(machine, covariances, table, records, tape, terms, health, after):
    """Write all terms, and the health (G, 3) of each record; a tape without numbers is not written.

    ``covariances`` are those to check, see `functions.checked`. The states that the filter leaves
    are written to ``after``, NaN where it fails, unless that is empty. Returns the numbers on the
    tape.
    """
    m, work, place = machine, workspace(machine), np.int64(0)
    set_all(after.reshape(after.size), np.nan)
    size, lanes = m.size * m.width, np.empty((N_OF_LANE, m.width), np.int64)
    for first in range(0, records.shape[0], m.width):
        group = records[first : min(first + m.width, records.shape[0])]
        load_parameters(m, table, group, work.W)
        begin(lanes, group, table.rows)
        call(m.start, m, n_lanes_of(m, group), work, work.states, work.forces, table.t0, 0, 1)
        copy(work.states[size:], work.states[:size])
        if table.before.size:
            load_states(m, table, group, work.states)
        n_alive = _set_out(m, covariances, work.W, lanes, group, terms, health)
        if n_alive == 0:
            continue
        if m.along != 0:
            place += _along(m, work, table, group[0], tape[place:], terms, health)
        else:
            place += _side_by_side(
                m, work, table, group, lanes, n_alive, tape[place:], terms, health
            )
        if after.size:
            store_states(m, table, group, work.states, health, after)
    return place


@njit_internal
def _side_by_side(machine, work, table, records, lanes, n_alive, tape, terms, health):
    """Go along the records of a group in lanes; return how many numbers are on the tape."""
    m, rows, n_lanes = machine, table.rows, n_lanes_of(machine, records)
    size = m.size * m.width
    W, states, t0 = work.W, work.states, table.t0
    d, seen = rows_at(m, W, m.rows.d, m.p), rows_at(m, W, m.rows.seen, 1)
    term = rows_at(m, W, m.rows.term, 1)
    k, place = np.int64(table.first), np.int64(0)
    while n_alive:
        step = earliest(lanes)
        if step == NEVER:
            break
        n_steps = 0
        for _ in range(n_stretches(step - k)):
            copy(states[n_steps * size :], states[:size])
            if tape.size > 0:
                copy(states, tape[place : place + size])
                place += size
            n_steps = min(STRETCH, step - k)
            load_forces(m, table, lanes, k, n_steps + 1, work.forces)
            call(m.predict, m, n_lanes, work, states, work.forces, t0, k, n_steps)
            k += n_steps
        last = states[n_steps * size :]
        if _observe(lanes, records, rows, table.observed, k, d, seen, terms):
            force = work.forces[n_steps * m.n_inputs * m.width :]
            call(m.update, m, n_lanes, work, last, force, t0, k, 1)
            made = last, force, t0, k
            n_alive -= _store_terms(m, work, made, lanes, records, seen, term, table, terms, health)
            last = last[size:]
        copy(last, states[:size])
    return place


@njit_internal
def _along(machine, work, table, record, tape, terms, health):
    """Go along a record alone to its last state; return how many numbers are on the tape."""
    m, states, stride = machine, work.states, np.int64(0)
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
def _set_out(machine, covariances, W, lanes, records, terms, health):
    """Set all terms to minus infinity; return how many records have valid covariances.

    A filter of moments would go on with a negative variance and give it a likelihood.
    """
    n_alive, root = 0, _room_for_roots(covariances)
    for lane in range(records.shape[0]):
        point, first = records[lane, POINT], records[lane, BEGIN]
        is_valid = True
        health[point, 0], health[point, 1], health[point, 2] = np.inf, NONE, -1.0
        for i in range(0, covariances.size, 3):
            row, size, failure = covariances[i : i + 3]
            if is_valid and not _is_covariance(machine, W, lane, int(row), int(size), root):
                is_valid = False
                health[point, 1], health[point, 2] = failure, first
        lanes[ALIVE, lane] = is_valid
        n_alive += is_valid
        for j in range(first, first + records[lane, N_ROWS]):
            terms[records[lane, SHIFT] + j] = -np.inf
    return n_alive


@njit_internal
def _room_for_roots(covariances):
    largest = 0
    for size in covariances[1::3]:
        largest = max(largest, int(size))
    return np.empty(largest * largest)


@njit_internal
def _is_covariance(machine, W, lane, row, n, room):
    """Whether the matrix in these rows of a lane is symmetric and non-negative."""
    root = room[: n * n].reshape((n, n))
    for i in range(n):
        for j in range(n):
            root[i, j] = W[(row + i * n + j) * machine.width + lane]
    covariance_root(root)
    for i in range(n):
        for j in range(n):
            if np.isnan(root[i, j]):
                return False
    return True


@njit_internal
def _observe(lanes, records, rows, observed, k, d, seen, terms):
    """Load the rows of step k; return whether a lane observes. A missing row has the term 0."""
    any_seen, width = False, lanes.shape[1]
    for lane in range(width):
        seen[lane] = 0.0
    for lane in range(records.shape[0]):
        if lanes[NEXT_STEP, lane] != k:
            continue
        j = lanes[ROW, lane]
        advance(lanes, lane, rows)
        if not lanes[ALIVE, lane]:
            continue
        if is_missing(observed, j):
            terms[records[lane, SHIFT] + j] = 0.0
            continue
        any_seen, seen[lane] = True, 1.0
        for i in range(observed.shape[1]):
            d[i * width + lane] = observed[j, i]
    return any_seen


@njit_internal
def _store_terms(machine, work, made, lanes, records, seen, term, table, terms, health):
    """Store the finite terms of an update; return how many records have none and fail there.

    It was ``made`` of the states and inputs at this step.
    """
    s, force, t0, k = made
    n_failed, width, n_lanes = 0, machine.width, n_lanes_of(machine, records)
    # A state that no observation depends on may be NaN where the term is finite.
    for i in range(machine.size):
        for lane in range(width):
            term[lane] += 0.0 * s[i * width + lane]
    for lane in range(records.shape[0]):
        if seen[lane] == 0.0:
            continue
        point, j = records[lane, POINT], lanes[ROW, lane] - 1
        if np.isfinite(term[lane]):
            terms[records[lane, SHIFT] + j] = term[lane]
            continue
        lanes[ALIVE, lane] = 0
        n_failed += 1
        d = table.observed[j]
        health[point, 1] = failure_in_lane(
            machine, work, n_lanes, lane, s, force, t0, k, d, term[lane]
        )
        health[point, 2] = j
    return n_failed


@njit_internal
def first_failure(of_records, health):
    """The health of the first record that fails, or of any."""
    health[0], health[1], health[2] = np.inf, NONE, -1.0
    for record in range(of_records.shape[0] - 1, -1, -1):
        if of_records[record, 1] != NONE:
            for i in range(HEALTH_SIZE):
                health[i] = of_records[record, i]


def _forward(plan, record, request, results):
    status, opening = opened(plan, record, request, results)
    if status != OK:
        return status
    machine, to = read_machine(opening.plan), opening.results
    status = status_of_states(opening, machine)
    if status != OK:
        return status
    if opening.plan[PLAN.leaves_tape]:
        records = records_of(opening, machine)
        to[RESULTS.n_tape] = n_states_on_tape(opening, machine, records)
        to[RESULTS.tape_width] = machine.size * machine.width
    if opening.request[REQUEST.sizes_only]:
        return status
    given, n_points = opening.record, to[RESULTS.n_points]
    terms = reals_at(to[RESULTS.terms], (n_points * given[RECORD.n_rows],))
    health = reals_at(to[RESULTS.health], (n_points, HEALTH_SIZE))
    for i in range(n_points):  # what stays if memory ends
        health[i, 0], health[i, 1], health[i, 2] = np.inf, OUT_OF_MEMORY, 0.0
    n_tape = to[RESULTS.n_tape] * to[RESULTS.tape_width] if to[RESULTS.tape] else 0
    tape = reals_at(to[RESULTS.tape], (n_tape,))
    records, is_panel = records_of(opening, machine), given[RECORD.row_width] > 1
    healths = np.empty((given[RECORD.n_records], HEALTH_SIZE)) if is_panel else health
    table = table_of(opening, parameters_of(opening), np.empty((0, 0)), np.empty(0))
    n_taped = forward_pass(
        machine, settings_of(opening.plan), table, records, tape, terms, healths,
        states_wanted(opening),
    )  # fmt: skip
    if is_panel:
        first_failure(healths, health[0])
    if n_tape:
        to[RESULTS.n_tape] = n_taped // to[RESULTS.tape_width] if health[0, 1] == NONE else 0
    return OK


FORWARD = plan_entry(_forward, "gaussian_forward")
