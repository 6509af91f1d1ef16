"""Records side by side in lanes: how a pass takes a group of them forward and back.

The tape has a state of each group at its rows, and at least every `STRETCH` steps. The way back
makes the steps between them again, which takes less time than to read all states from memory.
"""

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.numerics.order import stable_order
from ..outcomes import is_missing
from .failures import failure_in_lane
from .group import BEGIN, N_OF_RECORD, N_ROWS, POINT, SHIFT, Way, copy, step_at
from .lanes import (
    END,
    N_OF_LANE,
    NEVER,
    NEXT_STEP,
    ROW,
    advance,
    begin,
    earliest,
    end,
    latest,
    load_forces,
    n_stretches,
    retreat,
)
from .machine import STRETCH, call, n_lanes_of, rows_at


@njit_internal
def _longest_first(records, rows):
    """The records in the order in which they are grouped."""
    if rows.shape[1] == 1:
        return records
    last = np.empty(records.shape[0], np.int64)
    for i in range(last.size):
        last[i] = -step_at(rows, records[i, BEGIN] + records[i, N_ROWS] - 1)
    order = stable_order(last)
    sorted = np.empty((last.size, N_OF_RECORD), np.int64)
    for i in range(last.size):
        for column in range(N_OF_RECORD):
            sorted[i, column] = records[order[i], column]
    return sorted


@njit_internal
def _n_states(machine, rows, records):
    """The number of states on a tape, one for each lane."""
    total, lanes = np.int64(0), np.empty((N_OF_LANE, machine.width), np.int64)
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


@njit_internal
def _forward(machine, work, table, records, alive, tape, terms, health):
    """Go along the records of a group; return how many numbers are on the tape."""
    m, rows, n_lanes = machine, table.rows, n_lanes_of(machine, records)
    lanes = np.empty((N_OF_LANE, m.width), np.int64)
    begin(lanes, records, rows)
    size, n_alive = m.size * m.width, 0
    for lane in range(records.shape[0]):
        n_alive += alive[lane]
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
        if _observe(lanes, alive, records, rows, table.observed, k, d, seen, terms):
            force = work.forces[n_steps * m.n_inputs * m.width :]
            call(m.update, m, n_lanes, work, last, force, t0, k, 1)
            made = last, force, t0, k
            n_alive -= _store_terms(
                m, work, made, lanes, alive, records, seen, term, table, terms, health
            )
            last = last[size:]
        copy(last, states[:size])
    return place


@njit_internal
def _observe(lanes, alive, records, rows, observed, k, d, seen, terms):
    """Load the rows of step k; return whether a lane observes. A missing row has the term 0."""
    any_seen, width = False, lanes.shape[1]
    for lane in range(width):
        seen[lane] = 0.0
    for lane in range(records.shape[0]):
        if lanes[NEXT_STEP, lane] != k:
            continue
        j = lanes[ROW, lane]
        advance(lanes, lane, rows)
        if not alive[lane]:
            continue
        if is_missing(observed, j):
            terms[records[lane, SHIFT] + j] = 0.0
            continue
        any_seen, seen[lane] = True, 1.0
        for i in range(observed.shape[1]):
            d[i * width + lane] = observed[j, i]
    return any_seen


@njit_internal
def _store_terms(machine, work, made, lanes, alive, records, seen, term, table, terms, health):
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
        alive[lane] = False
        n_failed += 1
        d = table.observed[j]
        health[point, 1] = failure_in_lane(
            machine, work, n_lanes, lane, s, force, t0, k, d, term[lane]
        )
        health[point, 2] = j
    return n_failed


@njit_internal
def _backward(machine, work, table, records, tape, place, terms_bar):
    """Go back along the records of a group, from a place of the tape; return the next."""
    lanes = np.empty((N_OF_LANE, machine.width), np.int64)
    end(lanes, records, table.rows)
    m, states, n_lanes = machine, work.states, n_lanes_of(machine, records)
    size, t0, k = m.size * m.width, table.t0, latest(lanes)
    while k >= 0:
        any_seen = _observe_back(m, work.W, lanes, records, table, terms_bar, k)
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
def _observe_back(machine, W, lanes, records, table, terms_bar, k):
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


SIDE_BY_SIDE = Way("side_by_side", _longest_first, _n_states, _forward, _backward)
