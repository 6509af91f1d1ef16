"""The forward pass along records, compiled once for all systems, and once for each way."""

from collections.abc import Callable

import numpy as np

from ...compiler.native.entry_point import EntryPoint
from ...compiler.native.jit import njit_internal
from ...compiler.native.plan import HEALTH_SIZE, RECORD, REQUEST, RESULTS, plan_entry
from ...compiler.numerics.small_cholesky import covariance_root
from ..calls import OK, opened, reals_at
from ..outcomes import NONE, OUT_OF_MEMORY
from ..plan import PLAN, settings_of
from .alone import ALONE
from .group import (
    BEGIN,
    N_ROWS,
    POINT,
    SHIFT,
    Way,
    copy,
    load_parameters,
    load_states,
    parameters_of,
    records_of,
    rows_of,
    set_all,
    states_wanted,
    status_of_states,
    store_states,
    table_of,
)
from .machine import call, n_lanes_of, read_machine, workspace
from .side_by_side import SIDE_BY_SIDE


def _pass(way: Way) -> Callable:
    """Make the forward pass of this way."""
    forward = way.forward

    @njit_internal
    def forward_pass(machine, covariances, table, records, tape, terms, health, after):
        m, work, place = machine, workspace(machine), np.int64(0)
        set_all(after.reshape(after.size), np.nan)
        size, alive = m.size * m.width, np.empty(m.width, np.bool_)
        for first in range(0, records.shape[0], m.width):
            group = records[first : min(first + m.width, records.shape[0])]
            load_parameters(m, table, group, work.W)
            call(m.start, m, n_lanes_of(m, group), work, work.states, work.forces, table.t0, 0, 1)
            copy(work.states[size:], work.states[:size])
            if table.before.size:
                load_states(m, table, group, work.states)
            if not _set_out(m, covariances, work.W, alive, group, terms, health):
                continue
            place += forward(m, work, table, group, alive, tape[place:], terms, health)
            if after.size:
                store_states(m, table, group, work.states, health, after)
        return place

    return forward_pass


forward_pass = _pass(ALONE)
"""Write all terms, and the health (G, 3) of each record; a tape without numbers is not written.

``covariances`` are those to check, see `functions.checked`. The states that the filter leaves are
written to ``after``, NaN where it fails, unless that is empty. Returns the numbers on the tape.
"""


@njit_internal
def _set_out(machine, covariances, W, alive, records, terms, health):
    """Set all terms to minus infinity; say which records have valid covariances.

    A filter of moments would go on with a negative variance and give it a likelihood. Returns
    whether any is ``alive``.
    """
    any_alive, root = False, _room_for_roots(covariances)
    for lane in range(records.shape[0]):
        point, first = records[lane, POINT], records[lane, BEGIN]
        is_valid = True
        health[point, 0], health[point, 1], health[point, 2] = np.inf, NONE, -1.0
        for i in range(0, covariances.size, 3):
            row, size, failure = covariances[i : i + 3]
            if is_valid and not _is_covariance(machine, W, lane, int(row), int(size), root):
                is_valid = False
                health[point, 1], health[point, 2] = failure, first
        alive[lane] = is_valid
        any_alive |= is_valid
        for j in range(first, first + records[lane, N_ROWS]):
            terms[records[lane, SHIFT] + j] = -np.inf
    return any_alive


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
def first_failure(of_records, health):
    """The health of the first record that fails, or of any."""
    health[0], health[1], health[2] = np.inf, NONE, -1.0
    for record in range(of_records.shape[0] - 1, -1, -1):
        if of_records[record, 1] != NONE:
            for i in range(HEALTH_SIZE):
                health[i] = of_records[record, i]


def _entry(way: Way, forward_pass: Callable) -> EntryPoint:
    order, n_states = way.order, way.n_states

    def run(plan, record, request, results):
        status, opening = opened(plan, record, request, results)
        if status != OK:
            return status
        machine, to = read_machine(opening.plan), opening.results
        status = status_of_states(opening, machine)
        if status != OK:
            return status
        rows = rows_of(opening)
        records = order(records_of(opening), rows)
        if opening.plan[PLAN.leaves_tape]:
            to[RESULTS.n_tape] = n_states(machine, rows, records)
            to[RESULTS.tape_width] = machine.size * machine.width
        if opening.request[REQUEST.sizes_only]:
            return status
        given, n_points = opening.record, to[RESULTS.n_points]
        terms = reals_at(to[RESULTS.terms], (n_points * given[RECORD.n_rows],))
        health = reals_at(to[RESULTS.health], (n_points, HEALTH_SIZE))
        for i in range(n_points):  # what stays if memory ends
            health[i, 0], health[i, 1], health[i, 2] = np.inf, OUT_OF_MEMORY, 0.0
        n_tape = to[RESULTS.n_tape] * to[RESULTS.tape_width] if to[RESULTS.tape] else 0
        tape, is_panel = reals_at(to[RESULTS.tape], (n_tape,)), given[RECORD.row_width] > 1
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

    return plan_entry(run, f"gaussian_forward_{way.name}")


FORWARD = _entry(ALONE, forward_pass), _entry(SIDE_BY_SIDE, _pass(SIDE_BY_SIDE))
"""The forward pass of records one after the other, and of records side by side."""
