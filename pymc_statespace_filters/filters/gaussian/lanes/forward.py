"""The forward pass over many records, compiled once for all systems.

The tape has a state of each group at its rows, and at least every `STRETCH` steps. The way back
makes the steps between them again, which takes less time than to read all states from memory.
"""

import numpy as np
from numba import carray, types

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction, jit
from pymc_statespace_filters.compiler.codegen.simd import LANES
from pymc_statespace_filters.compiler.lowering.covariances import covariance_check
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.compiler.native.entry_point import (
    F64_PTR,
    I64_PTR,
    EntryPoint,
    address_of,
    arguments_class,
    call_address,
)
from pymc_statespace_filters.compiler.native.jit import njit_internal
from pymc_statespace_filters.filters.gaussian.lanes.group import (
    ALIVE,
    BEGIN,
    N_OF_LANE,
    N_OF_RECORD,
    N_ROWS,
    NEVER,
    NEXT_STEP,
    POINT,
    ROW,
    SHIFT,
    STRETCH,
    advance,
    begin,
    call,
    copy,
    earliest,
    load_inputs,
    load_parameters,
    n_lanes_of,
    n_stretches,
    rows_of,
    workspace,
)
from pymc_statespace_filters.filters.gaussian.lanes.table import forward_table, read_table
from pymc_statespace_filters.filters.gaussian.recursion import GaussianFilterFunctions
from pymc_statespace_filters.filters.outcomes import (
    COVARIANCE_NOT_POSITIVE,
    NO_FINITE_MEMBER,
    NONE,
    is_missing,
)
from pymc_statespace_filters.system.panel import N_COLUMNS

PASS_ARGUMENTS = {
    "table": I64_PTR, "theta": F64_PTR, "records": I64_PTR, "n_records": types.intp,
    "rows": I64_PTR, "n_rows": types.intp, "observed": F64_PTR, "inputs": F64_PTR,
    "n_input_rows": types.intp, "t0": types.float64, "dt": types.float64, "tape": F64_PTR,
    "n_taped": types.intp, "numbers": F64_PTR, "places": I64_PTR,
}  # fmt: skip
"""``records`` are those of `records`, in their order; the tape has the shape (n_taped, LANES).
``numbers`` and ``places`` are for `group.workspace` and the integers of all lanes."""

_ARGUMENTS = PASS_ARGUMENTS | {"terms": F64_PTR, "health": F64_PTR}

_Arguments = arguments_class("_Arguments", _ARGUMENTS, __name__)


def _forward(
    table, theta, records, n_records, rows, n_rows, observed, inputs, n_input_rows, t0, dt, tape,
    n_taped, numbers, places, terms, health,
):  # fmt: skip
    """Write all terms, and the health (G, 3) of each record; no tape is written if it has no rows.

    Records whose health has a failure already fail in their first row.
    """
    f = read_table(table)
    order, panel = carray(records, (n_records, N_OF_RECORD)), carray(rows, (n_rows, N_COLUMNS))
    points, data = carray(theta, (n_records, f.n_theta)), carray(observed, (n_rows, f.p))
    pushes = carray(inputs, (n_input_rows, f.n_inputs * (n_input_rows > 0)))
    out, of_records = carray(terms, (n_records * n_rows,)), carray(health, (n_records, 3))
    saved, place = carray(tape, (n_taped * LANES,)), 0
    size, force_size = f.size * LANES, f.n_inputs * LANES
    W, states, forces = workspace(numbers, f.n_rows, f.size, f.n_inputs)
    d, seen, term = rows_of(W, f.d, f.p), rows_of(W, f.seen, 1), rows_of(W, f.term, 1)
    s, lanes = states[:size], carray(places, (N_OF_LANE, LANES))
    for first in range(0, n_records, LANES):
        group = order[first : min(first + LANES, n_records)]
        n_lanes = n_lanes_of(group)
        load_parameters(f.n_theta, points, group, W)
        begin(lanes, group, panel)
        n_alive = _set_out(lanes, group, out, of_records)
        call(f.prepare, W, n_lanes, states, forces, t0, dt, 0, 1)
        copy(states[size:], s)
        k = 0
        while n_alive:
            step = earliest(lanes)
            if step == NEVER:
                break
            n_steps = 0
            for _ in range(n_stretches(step - k)):
                copy(states[n_steps * size :], s)
                if n_taped:
                    copy(s, saved[place : place + size])
                    place += size
                n_steps = min(STRETCH, step - k)
                load_inputs(pushes, lanes, k, n_steps + 1, forces)
                call(f.predict, W, n_lanes, states, forces, t0, dt, k, n_steps)
                k += n_steps
            last = states[n_steps * size :]
            if _observe(lanes, group, panel, data, k, d, seen, out):
                call(f.update, W, n_lanes, last, forces[n_steps * force_size :], t0, dt, k, 1)
                n_alive -= _store_terms(f.n, lanes, group, last[:size], seen, term, out, of_records)
                last = last[size:]
            copy(last, s)


@njit_internal
def _set_out(lanes, records, terms, health):
    """Set all terms to minus infinity; return how many records do not fail before the first row."""
    n_alive = 0
    for lane in range(records.shape[0]):
        point, first = records[lane, POINT], records[lane, BEGIN]
        lanes[ALIVE, lane] = health[point, 1] == NONE
        n_alive += lanes[ALIVE, lane]
        if not lanes[ALIVE, lane]:
            health[point, 2] = first
        for j in range(first, first + records[lane, N_ROWS]):
            terms[records[lane, SHIFT] + j] = -np.inf
    return n_alive


@njit_internal
def _observe(lanes, records, rows, observed, k, d, seen, terms):
    """Load the rows of step k; return whether a lane observes. A missing row has the term 0."""
    any_seen = False
    for lane in range(LANES):
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
            d[i * LANES + lane] = observed[j, i]
    return any_seen


@njit_internal
def _store_terms(n, lanes, records, s, seen, term, terms, health):
    """Store the finite terms of an update; return how many records have none and fail there.

    ``s`` are the states before it.
    """
    n_failed = 0
    # A state that no observation depends on may be NaN where the term is finite.
    for i in range(s.size // LANES):
        for lane in range(LANES):
            term[lane] += 0.0 * s[i * LANES + lane]
    for lane in range(records.shape[0]):
        if seen[lane] == 0.0:
            continue
        point, j = records[lane, POINT], lanes[ROW, lane] - 1
        if np.isfinite(term[lane]):
            terms[records[lane, SHIFT] + j] = term[lane]
            continue
        lanes[ALIVE, lane] = 0
        n_failed += 1
        finite = True
        for i in range(n):
            finite &= np.isfinite(s[i * LANES + lane])
        health[point, 1] = COVARIANCE_NOT_POSITIVE if finite else NO_FINITE_MEMBER
        health[point, 2] = j
    return n_failed


_FORWARD = EntryPoint(_forward, _ARGUMENTS, "lanes_forward")


def forward_pass(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta, records, rows, observed, inputs, t0, n_terms, n_states).

    It returns the terms, the health (G, 3) of each record, and a tape of so many states, or none.
    Raises NotUnrollableError if the filter cannot be written out in scalars.
    """
    table, valid = forward_table(recursion), covariance_check(recursion.system)
    make_table, has_valid_covariances = table.make, valid.function
    dt, size, n_numbers = recursion.system.dt, recursion.size, table.n_numbers
    _FORWARD.compile()
    forward = _FORWARD.symbol

    def run(theta, records, rows, observed, inputs, t0, n_terms, n_states):
        n_records = theta.shape[0]
        terms, health = np.empty(n_terms), np.empty((n_records, 3))
        tape = np.empty((n_states * size, LANES))
        for record in range(n_records):
            is_valid = has_valid_covariances(theta[record])
            health[record, 0], health[record, 2] = np.inf, -1.0
            health[record, 1] = NONE if is_valid else COVARIANCE_NOT_POSITIVE
        numbers, places = np.empty(n_numbers), np.empty((N_OF_LANE, LANES), np.int64)
        arguments = _Arguments(
            table=make_table(), theta=theta, records=records, n_records=n_records, rows=rows,
            n_rows=rows.shape[0], observed=observed, inputs=inputs, n_input_rows=inputs.shape[0],
            t0=t0, dt=dt, tape=tape, n_taped=tape.shape[0], numbers=numbers, places=places,
            terms=terms, health=health,
        )  # fmt: skip
        call_address(address_of(forward), arguments)
        return terms, health, tape

    key = key_of(__name__, f"forward pass {dt!r} {size}", table.key, valid.key, _FORWARD.key)
    return CompiledFunction(jit(run), key)
