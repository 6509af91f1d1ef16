"""The forward and the backward pass over many records, a group of them side by side at a time.

All lanes of a group go through the same steps; a lane observes where its own record has a row, and
one whose record has ended goes on without effect. Records of similar lengths are therefore put
together.

The tape has a state at each row of a record, and at least every `STRETCH` steps. The way back makes
the steps between them again, which takes less time than to read all states from memory.

The passes are entry points: compiled once for all systems.
"""

from typing import NamedTuple

import numpy as np
from numba import carray, types

from pymc_statespace_filters.compiler.codegen.simd import LANES, LANES_AT_ONCE, LaneArguments
from pymc_statespace_filters.compiler.native.cache_key import digest
from pymc_statespace_filters.compiler.native.entry_point import (
    F64_PTR,
    I64_PTR,
    EntryPoint,
    arguments_class,
    call_address,
)
from pymc_statespace_filters.compiler.native.jit import inline_always, njit_internal
from pymc_statespace_filters.filters.gaussian.lanes import read_table
from pymc_statespace_filters.filters.outcomes import (
    COVARIANCE_NOT_POSITIVE,
    NO_FINITE_MEMBER,
    NONE,
    is_missing,
)

STRETCH = 32  # steps; their states fit into the processor's cache

# Columns of the rows of a panel.
RECORD, STEP, FIRST_INPUT = range(3)
N_COLUMNS = 3

# Columns of the records: the row of theta, the first row of the panel and the number of rows, and
# what leads from a row to its term.
POINT, BEGIN, N_ROWS, SHIFT = range(4)
N_OF_RECORD = 4

NEVER = np.int64(2**62)
"""Later than any step."""

PASS_ARGUMENTS = {
    "table": I64_PTR, "theta": F64_PTR, "records": I64_PTR, "n_records": types.intp,
    "rows": I64_PTR, "n_rows": types.intp, "observed": F64_PTR, "inputs": F64_PTR,
    "n_input_rows": types.intp, "t0": types.float64, "dt": types.float64, "tape": F64_PTR,
    "n_taped": types.intp,
}  # fmt: skip
"""``records`` (G, 4) in the order of evaluation; a tape (n_taped, LANES) of elements of states."""

FORWARD_ARGUMENTS = PASS_ARGUMENTS | {"terms": F64_PTR, "health": F64_PTR, "used": I64_PTR}
BACKWARD_ARGUMENTS = {"forward": I64_PTR} | PASS_ARGUMENTS | {
    "terms_bar": F64_PTR, "theta_bar": F64_PTR
}  # fmt: skip
SORT_ARGUMENTS = {
    "rows": I64_PTR, "n_rows": types.intp, "records": I64_PTR, "n_records": types.intp
}  # fmt: skip
COUNT_ARGUMENTS = SORT_ARGUMENTS | {"n_states": I64_PTR}

ForwardArguments = arguments_class("ForwardArguments", FORWARD_ARGUMENTS, __name__)
BackwardArguments = arguments_class("BackwardArguments", BACKWARD_ARGUMENTS, __name__)
SortArguments = arguments_class("SortArguments", SORT_ARGUMENTS, __name__)
CountArguments = arguments_class("CountArguments", COUNT_ARGUMENTS, __name__)


class Lanes(NamedTuple):
    """Where the records of a group are, lane by lane.

    ``row`` is the next row of a record, ``end`` the row behind its last, ``next_step`` the step of
    its next row, `NEVER` behind the last. ``first_input`` is the row of the inputs at step 0.
    """

    row: np.ndarray
    end: np.ndarray
    next_step: np.ndarray
    first_input: np.ndarray


def _sort(rows, n_rows, records, n_records):
    """Find the records in the rows of a panel; put the longest first."""
    table, found = carray(rows, (n_rows, N_COLUMNS)), np.empty((n_records, N_OF_RECORD), np.int64)
    last = np.empty(n_records, np.int64)
    record = -1
    for j in range(n_rows):
        if j == 0 or table[j, RECORD] != table[j - 1, RECORD]:
            record += 1
            found[record, POINT], found[record, BEGIN] = record, j
            found[record, N_ROWS] = found[record, SHIFT] = 0
        found[record, N_ROWS] += 1
        last[record] = table[j, STEP]
    order = np.argsort(-last, kind="mergesort")
    out = carray(records, (n_records, N_OF_RECORD))
    for i in range(n_records):
        for column in range(N_OF_RECORD):
            out[i, column] = found[order[i], column]


def _count(rows, n_rows, records, n_records, n_states):
    """Count the states of a tape."""
    table, order = carray(rows, (n_rows, N_COLUMNS)), carray(records, (n_records, N_OF_RECORD))
    lanes, total = _new_lanes(), 0
    for first in range(0, n_records, LANES):
        group = order[first : min(first + LANES, n_records)]
        _begin(lanes, group, table)
        last = np.int64(0)
        step = _earliest(lanes.next_step)
        while step != NEVER:
            total += _n_stretches(step - last)
            last = step
            for lane in range(group.shape[0]):
                if lanes.next_step[lane] == step:
                    _advance(lanes, lane, table)
            step = _earliest(lanes.next_step)
    carray(n_states, (1,))[0] = total


@inline_always
def _n_stretches(n_steps):
    """The number of parts of so many steps up to a row; one if there are none."""
    return max(-(-n_steps // STRETCH), 1)


@njit_internal
def _new_lanes():
    empty = np.empty(LANES, np.int64)
    return Lanes(empty, empty.copy(), empty.copy(), empty.copy())


@njit_internal
def _begin(lanes, records, rows):
    """Put every lane before the first row of its record; spare lanes have none."""
    for lane in range(LANES):
        record = min(lane, records.shape[0] - 1)
        begin = records[record, BEGIN]
        lanes.row[lane], lanes.end[lane] = begin, begin + records[record, N_ROWS]
        lanes.next_step[lane] = rows[begin, STEP] if lane == record else NEVER
        lanes.first_input[lane] = rows[begin, FIRST_INPUT]


@inline_always
def _advance(lanes, lane, rows):
    row = lanes.row[lane] + 1
    lanes.row[lane] = row
    lanes.next_step[lane] = rows[row, STEP] if row < lanes.end[lane] else NEVER


@njit_internal
def _earliest(steps):
    earliest = NEVER
    for lane in range(LANES):
        earliest = min(earliest, steps[lane])
    return earliest


@njit_internal
def _load_parameters(table, theta, records, W):
    """Write the parameters of the records to lanes; spare lanes repeat the last record."""
    for lane in range(LANES):
        point = records[min(lane, records.shape[0] - 1), POINT]
        for i in range(table.n_theta):
            W[i * LANES + lane] = theta[point, i]


@njit_internal
def _load_inputs(inputs, first_input, k, n_steps, forces):
    """Write the inputs of some steps; a record that has ended may have none left."""
    last, n = inputs.shape[0] - 1, inputs.shape[1]
    shared = True
    for lane in range(LANES):
        shared &= first_input[lane] == first_input[0]
    for step in range(n_steps):
        for i in range(n):
            row = forces[(step * n + i) * LANES :]
            if shared:
                value = inputs[min(first_input[0] + k + step, last), i]
                for lane in range(LANES):
                    row[lane] = value
            else:
                for lane in range(LANES):
                    row[lane] = inputs[min(first_input[lane] + k + step, last), i]


@njit_internal
def _copy(source, target):
    for i in range(target.size):
        target[i] = source[i]


@njit_internal
def _new_rows(n_rows):
    """Rows of zeros at a multiple of 64 bytes, which a vector instruction reads at once."""
    numbers = np.empty(n_rows * LANES + 8)
    skipped = (-numbers.ctypes.data % 64) // 8
    numbers[:] = 0.0
    return numbers[skipped : skipped + n_rows * LANES]


@inline_always
def _rows(W, first, n):
    return W[first * LANES : (first + n) * LANES]


def _forward(
    table, theta, records, n_records, rows, n_rows, observed, inputs, n_input_rows, t0, dt, tape,
    n_taped, terms, health, used,
):  # fmt: skip
    """Write all terms, and the health (G, 3) of each record; ``used`` is the length of the tape.

    Records whose health has a failure already fail in their first row.
    """
    f = read_table(table)
    order, panel = carray(records, (n_records, N_OF_RECORD)), carray(rows, (n_rows, N_COLUMNS))
    points, data = carray(theta, (n_records, f.n_theta)), carray(observed, (n_rows, f.p))
    forces = carray(inputs, (n_input_rows, f.n_inputs * (n_input_rows > 0)))
    out, of_record = carray(terms, (n_records * n_rows,)), carray(health, (n_records, 3))
    saved, place, size = carray(tape, (n_taped * LANES,)), 0, f.size * LANES
    W, path, pushes = _workspace(f, f.n_rows)
    s, d, seen, term = path[:size], _rows(W, f.d, f.p), _rows(W, f.seen, 1), _rows(W, f.term, 1)
    lanes, alive = _new_lanes(), np.empty(LANES, np.bool_)
    for first in range(0, n_records, LANES):
        group = order[first : min(first + LANES, n_records)]
        n_lanes = -(-group.shape[0] // LANES_AT_ONCE) * LANES_AT_ONCE
        _load_parameters(f, points, group, W)
        _begin(lanes, group, panel)
        _set_out(group, out, of_record, alive)
        k, n_steps = np.int64(0), np.int64(0)
        _call(f.prepare, W, n_lanes, path, pushes, 0, t0, dt, k, 1)
        _copy(path[size:], s)
        while alive[: group.shape[0]].any():
            step = _earliest(lanes.next_step)
            if step == NEVER:
                break
            for _ in range(_n_stretches(step - k)):
                if n_taped:
                    _copy(s, saved[place : place + size])
                    place += size
                n_steps = min(step - k, STRETCH)
                _load_inputs(forces, lanes.first_input, k, n_steps + 1, pushes)
                _call(f.predict, W, n_lanes, path, pushes, 0, t0, dt, k, n_steps)
                k += n_steps
                if k < step:
                    _copy(path[n_steps * size :], s)
            last = path[n_steps * size :]
            if _observe(lanes, group, panel, data, k, alive, d, seen, out):
                _call(f.update, W, n_lanes, path, pushes, n_steps, t0, dt, k, 1)
                _store_terms(f.n, lanes, group, last, seen, term, alive, out, of_record)
                last = last[size:]
            _copy(last, s)
    carray(used, (1,))[0] = place // LANES


@njit_internal
def _workspace(f, n_rows):
    """The rows of parameters and vectors, states of a stretch and an update, and their inputs."""
    path = _new_rows((STRETCH + 2) * f.size)
    return _new_rows(n_rows), path, _new_rows((STRETCH + 1) * f.n_inputs)


@njit_internal
def _call(function, W, n_lanes, path, pushes, place, t0, dt, k, n_steps):
    """Call a function of a table for steps whose states begin at a place of a stretch."""
    states = path[place * (path.size // (STRETCH + 2)) :]
    arguments = LaneArguments(
        W=W, n_lanes=n_lanes, states=states, forces=pushes[place * (pushes.size // (STRETCH + 1)) :],
        t0=t0, dt=dt, k=k, n_steps=n_steps,
    )  # fmt: skip
    call_address(function, arguments)


@njit_internal
def _set_out(records, terms, health, alive):
    """Set all terms to minus infinity; mark the records that fail before their first row."""
    for lane in range(records.shape[0]):
        point, begin = records[lane, POINT], records[lane, BEGIN]
        alive[lane] = health[point, 1] == NONE
        if not alive[lane]:
            health[point, 2] = begin
        for j in range(begin, begin + records[lane, N_ROWS]):
            terms[records[lane, SHIFT] + j] = -np.inf


@njit_internal
def _observe(lanes, records, rows, observed, k, alive, d, seen, terms):
    """Load the rows of step k; return whether a lane observes. A missing row has the term 0."""
    any_seen = False
    for lane in range(LANES):
        seen[lane] = 0.0
    for lane in range(records.shape[0]):
        if lanes.next_step[lane] != k:
            continue
        j = lanes.row[lane]
        _advance(lanes, lane, rows)
        if not alive[lane]:
            continue
        if is_missing(observed, j):
            terms[records[lane, SHIFT] + j] = 0.0
            continue
        any_seen, seen[lane] = True, 1.0
        for i in range(observed.shape[1]):
            d[i * LANES + lane] = observed[j, i]
    return any_seen


@njit_internal
def _store_terms(n, lanes, records, s, seen, term, alive, terms, health):
    """Store the finite terms of an update; a record without one fails there."""
    for lane in range(records.shape[0]):
        if seen[lane] == 0.0:
            continue
        point, j = records[lane, POINT], lanes.row[lane] - 1
        if np.isfinite(term[lane]):
            terms[records[lane, SHIFT] + j] = term[lane]
            continue
        alive[lane] = False
        finite = True
        for i in range(n):  # such an update leaves the state as it is
            finite &= np.isfinite(s[i * LANES + lane])
        health[point, 1] = COVARIANCE_NOT_POSITIVE if finite else NO_FINITE_MEMBER
        health[point, 2] = j


def _backward(
    forward, table, theta, records, n_records, rows, n_rows, observed, inputs, n_input_rows, t0, dt, tape,
    n_taped, terms_bar, theta_bar,
):  # fmt: skip
    """Write the cotangents of all parameters."""
    f, b = read_table(forward), read_table(table)
    order, panel = carray(records, (n_records, N_OF_RECORD)), carray(rows, (n_rows, N_COLUMNS))
    points, data = carray(theta, (n_records, f.n_theta)), carray(observed, (n_rows, f.p))
    forces = carray(inputs, (n_input_rows, f.n_inputs * (n_input_rows > 0)))
    bars, out = carray(terms_bar, (n_rows,)), carray(theta_bar, (n_records, f.n_theta))
    saved, place, size = carray(tape, (n_taped * LANES,)), n_taped * LANES, f.size * LANES
    W, path, pushes = _workspace(f, b.n_rows)
    s, d, seen, term_bar = path[:size], _rows(W, b.d, b.p), _rows(W, b.seen, 1), _rows(W, b.term, 1)
    s_bar, c_bar, lanes = _rows(W, b.s_bar, b.size), _rows(W, b.c_bar, b.n_theta), _new_lanes()
    for number in range(-(-n_records // LANES) - 1, -1, -1):
        first = number * LANES
        group = order[first : min(first + LANES, n_records)]
        n_lanes = -(-group.shape[0] // LANES_AT_ONCE) * LANES_AT_ONCE
        _load_parameters(f, points, group, W)
        _end(lanes, group, panel)
        k = _latest(lanes.next_step)
        _call(f.prepare, W, n_lanes, path, pushes, 0, t0, dt, k, 1)
        _call(b.prepare, W, n_lanes, path, pushes, 0, t0, dt, k, 1)
        while k >= 0:
            any_seen = _observe_back(
                lanes, group, panel, data, bars, k, d, seen, term_bar, s_bar, c_bar
            )
            end, step = k, _latest(lanes.next_step)
            for part in range(_n_stretches(end - max(step, 0)) - 1, -1, -1):
                begin = max(step, 0) + part * STRETCH
                n_steps = k - begin
                place -= size
                _copy(saved[place:], s)
                _load_inputs(forces, lanes.first_input, begin, n_steps + 1, pushes)
                _call(f.predict, W, n_lanes, path, pushes, 0, t0, dt, begin, n_steps)
                if any_seen and k == end:
                    _call(b.update, W, n_lanes, path, pushes, n_steps, t0, dt, k, 1)
                _call(b.predict, W, n_lanes, path, pushes, 0, t0, dt, begin, n_steps)
                k = begin
            k = step
        _call(b.finish, W, n_lanes, path, pushes, 0, t0, dt, k, 1)
        for lane in range(group.shape[0]):
            for i in range(f.n_theta):
                out[group[lane, POINT], i] = c_bar[i * LANES + lane]


@njit_internal
def _end(lanes, records, rows):
    """Put every lane behind the last row of its record, ``next_step`` to that row's step."""
    _begin(lanes, records, rows)
    for lane in range(LANES):
        row = lanes.end[lane] - 1
        lanes.row[lane] = row
        lanes.next_step[lane] = rows[row, STEP] if lane < records.shape[0] else -1


@njit_internal
def _latest(steps):
    latest = np.int64(-1)
    for lane in range(LANES):
        latest = max(latest, steps[lane])
    return latest


@njit_internal
def _observe_back(
    lanes, records, rows, observed, terms_bar, k, d, seen, term_bar, s_bar, c_bar
):  # fmt: skip
    """Load the rows of step k. The cotangents of a record are zero until its last row."""
    any_seen = False
    for lane in range(LANES):
        seen[lane] = 0.0
    for lane in range(records.shape[0]):
        if lanes.next_step[lane] != k:
            continue
        j = lanes.row[lane]
        lanes.row[lane] = j - 1
        lanes.next_step[lane] = rows[j - 1, STEP] if j > records[lane, BEGIN] else -1
        if j + 1 == lanes.end[lane]:
            for i in range(lane, s_bar.size, LANES):
                s_bar[i] = 0.0
            for i in range(lane, c_bar.size, LANES):
                c_bar[i] = 0.0
        if is_missing(observed, j):
            continue
        any_seen, seen[lane] = True, 1.0
        term_bar[lane] = terms_bar[j]
        for i in range(observed.shape[1]):
            d[i * LANES + lane] = observed[j, i]
    return any_seen


def _entry_point(function, arguments, name):
    return EntryPoint(function, arguments, name, digest(name))


SORT_RECORDS = _entry_point(_sort, SORT_ARGUMENTS, "sort_records")
"""Find the records of a panel, the longest first."""

COUNT_STATES = _entry_point(_count, COUNT_ARGUMENTS, "count_states")
"""Count the states of a tape."""

FORWARD = _entry_point(_forward, FORWARD_ARGUMENTS, "panel_forward")
"""The forward pass over all records."""

BACKWARD = _entry_point(_backward, BACKWARD_ARGUMENTS, "panel_backward")
"""The backward pass over all records."""
