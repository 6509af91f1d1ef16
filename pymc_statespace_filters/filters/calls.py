"""What a compiled filter reads of a call, and where it writes: one record after the other."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numba import carray

from ..compiler.native.entry_point import EntryPoint, pointer
from ..compiler.native.jit import copy_into, njit_callable, njit_internal
from ..compiler.native.plan import (
    DAMAGED,
    HEALTH_SIZE,
    INPUT_COLUMNS,
    INPUT_ROWS,
    N_RECORD,
    N_REQUEST,
    N_RESULTS,
    OBSERVED,
    PANEL_COLUMNS,
    PANEL_RECORDS,
    PANEL_STEPS,
    RECORD,
    REQUEST,
    RESULTS,
    STEPS,
    plan_entry,
    plan_words,
)
from ..compiler.numerics.philox import seed_of_record
from ..system import panel_records as panel
from .outcomes import NONE, OUT_OF_MEMORY
from .plan import PLAN, VERSION

OK = np.int64(0)
ALL_STEPS = np.int64(np.iinfo(np.int64).max)
_BYTES = 8
_SINGLE, _PANEL = 1, panel.N_COLUMNS


class Call(NamedTuple):
    """The words of a plan, a record, a request and results; see `compiler.native.plan`."""

    plan: np.ndarray
    record: np.ndarray
    request: np.ndarray
    results: np.ndarray


class Record(NamedTuple):
    """One record: parameters (k,), data (J, p) at steps (J,), inputs, and the time of step 0."""

    theta: np.ndarray
    steps: np.ndarray
    observed: np.ndarray
    inputs: np.ndarray
    t0: float


class Terms(NamedTuple):
    """Where the results of one record go: terms (J,), effective numbers (J,), and health (3,).

    ``state`` is the filter after the last row, of a length that the filter knows; none is wanted
    where it is empty.
    """

    terms: np.ndarray
    n_effective: np.ndarray
    health: np.ndarray
    state: np.ndarray


@njit_internal
def reals_at(address, shape):
    """The array of real numbers at an address, of a shape given as a tuple."""
    return carray(pointer(address), shape, np.float64)


@njit_internal
def integers_at(address, size):
    """The integers at an address, a vector."""
    return carray(pointer(address), (size,), np.int64)


@njit_internal
def opened(plan, record, request, results):
    """A status, and the call if it is `OK`; the sizes of its results are written."""
    words = plan_words(plan, VERSION)
    call = Call(
        words, carray(record, (N_RECORD,)), carray(request, (N_REQUEST,)),
        carray(results, (N_RESULTS,)),
    )  # fmt: skip
    if words.size == 0:
        return np.int64(DAMAGED), call
    sizes, given = call.results, call.record
    sizes[RESULTS.n_points] = given[RECORD.n_records] if given[RECORD.row_width] == _SINGLE else 1
    sizes[RESULTS.n_terms] = given[RECORD.n_rows]
    sizes[RESULTS.n_wanted] = call.request[REQUEST.n_wanted]
    sizes[RESULTS.n_states], sizes[RESULTS.n_members] = words[PLAN.n], words[PLAN.n_members]
    sizes[RESULTS.n_observables] = words[PLAN.p]
    sizes[RESULTS.n_records] = given[RECORD.n_records]
    sizes[RESULTS.n_theta] = given[RECORD.n_theta]
    sizes[RESULTS.n_state] = words[PLAN.state_size]
    return _check_record(call), call


@njit_internal
def _check_record(call):
    """Whether rows, data and inputs are those of a record or a panel of this system."""
    given, plan = call.record, call.plan
    n_rows, width = given[RECORD.n_rows], given[RECORD.row_width]
    status = status_of_rows(
        integers_at(given[RECORD.rows], n_rows * width), width, given[RECORD.n_records],
        given[RECORD.n_input_rows], given[RECORD.n_inputs], plan[PLAN.n_inputs],
        plan[PLAN.observation_uses_inputs],
    )  # fmt: skip
    if status != OK:
        return status
    if given[RECORD.n_observed] != n_rows or given[RECORD.n_observables] != plan[PLAN.p]:
        return np.int64(OBSERVED)
    return OK


@njit_callable
def status_of_rows(rows, width, n_records, n_input_rows, n_columns, n_inputs, last_row):
    """A status: whether rows, one behind the other, are those of so many records and inputs.

    The inputs have ``n_columns`` and should have ``n_inputs``. The row of the last step is read if
    ``last_row`` is 1.
    """
    if width != _SINGLE and width != _PANEL:
        return np.int64(PANEL_COLUMNS)
    if n_inputs and n_columns != n_inputs:
        return np.int64(INPUT_COLUMNS)
    found, step_column = np.int64(0), np.int64(panel.STEP if width == _PANEL else 0)
    for row in range(0, rows.size, width):
        first_input, begins = np.int64(0), row == 0
        if width == _PANEL:
            begins = begins or rows[row + panel.RECORD] != rows[row - width + panel.RECORD]
            first_input = rows[row + panel.FIRST_INPUT]
        found += begins
        step = rows[row + step_column]
        if step < 0 or (not begins and step <= rows[row - width + step_column]):
            return np.int64(STEPS if width == _SINGLE else PANEL_STEPS)
        if n_inputs and n_input_rows < first_input + step + last_row:
            return np.int64(INPUT_ROWS)
    return np.int64(PANEL_RECORDS) if width == _PANEL and found != n_records else OK


@njit_internal
def state_given(request):
    """The state from which the filter goes on; empty where it starts."""
    return reals_at(request[REQUEST.state], (request[REQUEST.n_state],))


@njit_internal
def state_wanted(call):
    """Where the state of the filter after the last row goes; empty if it is not wanted."""
    address = call.results[RESULTS.state]
    return reals_at(address, (call.results[RESULTS.n_state] if address != 0 else 0,))


@njit_internal
def wanted_rows(call):
    """The steps at which states are wanted."""
    return integers_at(call.request[REQUEST.wanted], call.request[REQUEST.n_wanted])


@njit_internal
def first_unknown(call, health):
    """The step from which on states are unknown: that of a failing observation, if there is one."""
    if health[1] == NONE:
        return ALL_STEPS
    steps = integers_at(call.record[RECORD.rows], call.record[RECORD.n_rows])
    return steps[int(health[2])]


@njit_internal
def end_of_record(call, first):
    """The row behind the record that begins in row ``first``."""
    given = call.record
    n_rows, width = given[RECORD.n_rows], given[RECORD.row_width]
    if width == _SINGLE:
        return n_rows
    rows, last = integers_at(given[RECORD.rows], n_rows * width), first
    while last < n_rows and rows[last * width] == rows[first * width]:  # the column RECORD
        last += 1
    return last


@njit_internal
def single_record(call, number, first, last):
    """The record of this number, which has the rows from ``first`` to ``last`` (exclusive)."""
    given, p = call.record, call.plan[PLAN.p]
    k, width = given[RECORD.n_theta], given[RECORD.row_width]
    first_input = np.int64(0)
    if width == _SINGLE:
        steps = integers_at(given[RECORD.rows], given[RECORD.n_rows])
    else:
        rows = integers_at(given[RECORD.rows], given[RECORD.n_rows] * width)
        steps = np.empty(last - first, np.int64)
        for j in range(steps.size):
            steps[j] = rows[(first + j) * width + panel.STEP]
            first_input = rows[(first + j) * width + panel.FIRST_INPUT]
    n_inputs, n_rows = given[RECORD.n_inputs], given[RECORD.n_input_rows] - first_input
    start = number if given[RECORD.n_starts] > 1 else 0
    return Record(
        theta=reals_at(given[RECORD.theta] + _BYTES * number * k, (k,)),
        steps=steps,
        observed=reals_at(given[RECORD.observed] + _BYTES * first * p, (last - first, p)),
        inputs=reals_at(given[RECORD.inputs] + _BYTES * first_input * n_inputs, (n_rows, n_inputs)),
        t0=reals_at(given[RECORD.starts], (given[RECORD.n_starts],))[start],
    )


@njit_internal
def _seed(call, first):
    """The seed of the record that begins in row ``first``."""
    given, seed = call.record, call.request[REQUEST.seed]
    if given[RECORD.row_width] == _SINGLE or given[RECORD.n_rows] == 0:
        return seed
    rows = integers_at(given[RECORD.rows], given[RECORD.n_rows] * given[RECORD.row_width])
    return seed_of_record(seed, rows[first * given[RECORD.row_width] + panel.RECORD])


@njit_callable
def include_health(health, of_record, first):
    """Include the health of a record whose first row is ``first`` in that of its panel."""
    health[0] = min(health[0], of_record[0])
    if health[1] == NONE and of_record[1] != NONE:
        health[1], health[2] = of_record[1], first + of_record[2]


def likelihood_entry(
    name: str,
    evaluate: Callable,
    parts: Sequence[str | Callable] = (),
    needs: Sequence[EntryPoint] = (),
) -> EntryPoint:
    """An entry point that evaluates the records of a call one after the other.

    ``evaluate(plan, record, request, seed, to)`` is a compiled function of the words of the plan
    and of the request, a `Record`, and the `Terms` that it writes. It returns a status. ``parts``
    identify what it closes over, see `key_of`.
    """

    def run(plan, record, request, results):
        status, call = opened(plan, record, request, results)
        if status != OK or call.request[REQUEST.sizes_only]:
            return status
        n_rows, is_panel = call.record[RECORD.n_rows], call.record[RECORD.row_width] == _PANEL
        n_points, to = call.results[RESULTS.n_points], call.results
        terms = reals_at(to[RESULTS.terms], (n_points * n_rows,))
        healths = reals_at(to[RESULTS.health], (n_points, HEALTH_SIZE))
        of_panel = np.array([np.inf, float(NONE), -1.0])
        # What stays if machine code raises, as where memory ends.
        terms[:] = -np.inf
        for i in range(n_points):
            healths[i, 0], healths[i, 1], healths[i, 2] = 0.0, OUT_OF_MEMORY, 0.0
        first, before = np.int64(0), np.int64(0)
        for number in range(call.record[RECORD.n_records]):
            last, health = end_of_record(call, first), healths[0 if is_panel else number]
            own = terms[before + first : before + last]
            numbers = np.empty(own.size)
            if to[RESULTS.n_effective] != 0:
                numbers = reals_at(to[RESULTS.n_effective] + _BYTES * first, (own.size,))
            numbers[:] = np.nan
            status = evaluate(
                call.plan, single_record(call, number, first, last), call.request,
                _seed(call, first), Terms(own, numbers, health, state_wanted(call)),
            )  # fmt: skip
            if status != OK:
                return status
            if is_panel:
                include_health(of_panel, health, first)
                first = last
            else:
                before += n_rows
        if is_panel:
            copy_into(healths[0], of_panel)
        return OK

    return plan_entry(run, name, (evaluate, *parts), needs)
