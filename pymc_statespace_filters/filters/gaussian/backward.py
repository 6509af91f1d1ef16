"""The backward pass along the tape of the forward pass, compiled once for all systems."""

from collections.abc import Callable

import numpy as np

from ...compiler.native.entry_point import EntryPoint, address_of, call_address, call_for_status
from ...compiler.native.jit import keep_alive, njit_internal
from ...compiler.native.plan import (
    HEALTH_SIZE,
    N_RESULTS,
    RECORD,
    REQUEST,
    RESULTS,
    plan_entry,
)
from ..calls import OK, opened, reals_at
from ..outcomes import NONE
from ..plan import PLAN
from .alone import ALONE
from .forward import FORWARD
from .group import (
    POINT,
    Way,
    copy,
    load_parameters,
    parameters_of,
    records_of,
    set_all,
    table_of,
)
from .machine import call, n_lanes_of, read_machine, rows_at, workspace
from .side_by_side import SIDE_BY_SIDE


def _pass(way: Way) -> Callable:
    """Make the backward pass of this way, which writes the cotangents of all parameters."""
    backward = way.backward

    @njit_internal
    def backward_pass(machine, table, records, tape, terms_bar, theta_bar):
        m, work, place = machine, workspace(machine), tape.size
        W, n_records, t0 = work.W, records.shape[0], table.t0
        c_bar = rows_at(m, W, m.rows.c_bar, m.n_theta)
        for first in range(m.width * ((n_records - 1) // m.width), -1, -m.width):
            group = records[first : min(first + m.width, n_records)]
            n_lanes = n_lanes_of(m, group)
            load_parameters(m, table, group, W)
            call(m.start, m, n_lanes, work, work.states, work.forces, t0, 0, 1)
            call(m.prepare_back, m, n_lanes, work, work.states, work.forces, t0, 0, 1)
            place = backward(m, work, table, group, tape, place, terms_bar)
            call(m.finish_back, m, n_lanes, work, work.states, work.forces, t0, 0, 1)
            for lane in range(group.shape[0]):
                for i in range(m.n_theta):
                    theta_bar[group[lane, POINT], i] = c_bar[i * m.width + lane]

    return backward_pass


def _tape(way: Way, forward: EntryPoint) -> Callable:
    """Make the function that finds the tape of a call."""
    n_states, symbol = way.n_states, forward.symbol

    @njit_internal
    def tape_of(call, machine, table, records):
        """The tape that a call brings, or that of a forward pass; empty if this fails."""
        request, n_rows = call.request, call.record[RECORD.n_rows]
        if not call.plan[PLAN.leaves_tape]:
            return reals_at(
                request[REQUEST.tape], (request[REQUEST.n_tape] * request[REQUEST.tape_width],)
            )
        width, n_records = machine.size * machine.width, table.theta.shape[0]
        tape = np.empty(n_states(machine, table.rows, records) * width)
        terms, health = np.empty(n_rows * n_records), np.empty((n_records, HEALTH_SIZE))
        to = np.zeros(N_RESULTS, np.int64)
        to[RESULTS.tape], to[RESULTS.terms] = tape.ctypes.data, terms.ctypes.data
        to[RESULTS.health] = health.ctypes.data
        status = call_for_status(address_of(symbol), (call.plan, call.record, request, to))
        keep_alive(terms)
        if status != OK:
            return tape[:0]
        for point in range(to[RESULTS.n_points]):
            if health[point, 1] != NONE:
                return tape[:0]
        return tape[: to[RESULTS.n_tape] * width]

    return tape_of


def _entry(way: Way, forward: EntryPoint) -> EntryPoint:
    order, tape_of, backward_pass = way.order, _tape(way, forward), _pass(way)

    def run(plan, record, request, results):
        status, call = opened(plan, record, request, results)
        if status != OK or call.request[REQUEST.sizes_only]:
            return status
        machine, given = read_machine(call.plan), call.record
        n_records, n_theta = given[RECORD.n_records], given[RECORD.n_theta]
        theta_bar = reals_at(call.results[RESULTS.theta_bar], (n_records, n_theta))
        set_all(theta_bar.reshape(theta_bar.size), 0.0)
        table = table_of(call, parameters_of(call), np.empty((0, 0)), np.empty(0))
        records = order(records_of(call), table.rows)
        tape = tape_of(call, machine, table, records)
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

    return plan_entry(run, f"gaussian_backward_{way.name}", needs=[forward])


BACKWARD = _entry(ALONE, FORWARD[0]), _entry(SIDE_BY_SIDE, FORWARD[1])
"""The backward pass of records one after the other, and of records side by side."""
