"""The backward pass along the tape of the forward pass, compiled once for all systems."""

import numpy as np
from numba import carray

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction, jit
from pymc_statespace_filters.compiler.codegen.simd import LANES
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
from pymc_statespace_filters.filters.gaussian.lanes.forward import PASS_ARGUMENTS
from pymc_statespace_filters.filters.gaussian.lanes.group import (
    END,
    N_OF_LANE,
    N_OF_RECORD,
    NEXT_STEP,
    POINT,
    ROW,
    STRETCH,
    call,
    copy,
    end,
    latest,
    load_inputs,
    load_parameters,
    n_lanes_of,
    n_stretches,
    retreat,
    rows_of,
    workspace,
)
from pymc_statespace_filters.filters.gaussian.lanes.table import (
    backward_table,
    forward_table,
    read_table,
)
from pymc_statespace_filters.filters.gaussian.recursion import GaussianFilterFunctions
from pymc_statespace_filters.filters.outcomes import is_missing
from pymc_statespace_filters.system.panel import N_COLUMNS

_ARGUMENTS = {
    "forward": I64_PTR, **PASS_ARGUMENTS, "terms_bar": F64_PTR, "theta_bar": F64_PTR
}  # fmt: skip

_Arguments = arguments_class("_Arguments", _ARGUMENTS, __name__)


def _backward(
    forward, table, theta, records, n_records, rows, n_rows, observed, inputs, n_input_rows, t0, dt,
    tape, n_taped, numbers, places, terms_bar, theta_bar,
):  # fmt: skip
    """Write the cotangents of all parameters."""
    f, b = read_table(forward), read_table(table)
    order, panel = carray(records, (n_records, N_OF_RECORD)), carray(rows, (n_rows, N_COLUMNS))
    points, data = carray(theta, (n_records, f.n_theta)), carray(observed, (n_rows, f.p))
    pushes = carray(inputs, (n_input_rows, f.n_inputs * (n_input_rows > 0)))
    bars, out = carray(terms_bar, (n_rows,)), carray(theta_bar, (n_records, f.n_theta))
    saved, place = carray(tape, (n_taped * LANES,)), n_taped * LANES
    size, force_size = f.size * LANES, f.n_inputs * LANES
    W, states, forces = workspace(numbers, b.n_rows, f.size, f.n_inputs)
    d, seen, term_bar = rows_of(W, b.d, b.p), rows_of(W, b.seen, 1), rows_of(W, b.term, 1)
    s_bar, c_bar = rows_of(W, b.s_bar, b.size), rows_of(W, b.c_bar, b.n_theta)
    s, lanes = states[:size], carray(places, (N_OF_LANE, LANES))
    for first in range(LANES * ((n_records - 1) // LANES), -1, -LANES):
        group = order[first : min(first + LANES, n_records)]
        n_lanes = n_lanes_of(group)
        load_parameters(f.n_theta, points, group, W)
        end(lanes, group, panel)
        call(f.prepare, W, n_lanes, states, forces, t0, dt, 0, 1)
        call(b.prepare, W, n_lanes, states, forces, t0, dt, 0, 1)
        k = latest(lanes)
        while k >= 0:
            any_seen = _observe(lanes, group, panel, data, bars, k, d, seen, term_bar, s_bar, c_bar)
            step, row = latest(lanes), k
            origin = max(step, 0)
            for number in range(n_stretches(row - origin) - 1, -1, -1):
                start = origin + number * STRETCH
                n_steps = k - start
                place -= size
                copy(saved[place:], s)
                load_inputs(pushes, lanes, start, n_steps + 1, forces)
                call(f.predict, W, n_lanes, states, forces, t0, dt, start, n_steps)
                if any_seen and k == row:
                    last, push = states[n_steps * size :], forces[n_steps * force_size :]
                    call(b.update, W, n_lanes, last, push, t0, dt, k, 1)
                call(b.predict, W, n_lanes, states, forces, t0, dt, start, n_steps)
                k = start
            k = step
        call(b.finish, W, n_lanes, states, forces, t0, dt, 0, 1)
        for lane in range(group.shape[0]):
            for i in range(f.n_theta):
                out[group[lane, POINT], i] = c_bar[i * LANES + lane]


@njit_internal
def _observe(
    lanes, records, rows, observed, terms_bar, k, d, seen, term_bar, s_bar, c_bar
):  # fmt: skip
    """Load the rows of step k. The cotangents of a record are zero until its last row."""
    any_seen = False
    for lane in range(LANES):
        seen[lane] = 0.0
    for lane in range(records.shape[0]):
        if lanes[NEXT_STEP, lane] != k:
            continue
        j = lanes[ROW, lane]
        retreat(lanes, lane, records, rows)
        if j + 1 == lanes[END, lane]:
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


_BACKWARD = EntryPoint(_backward, _ARGUMENTS, "lanes_backward")


def backward_pass(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta, records, rows, observed, inputs, t0, tape, terms_bar) -> theta_bar.

    Raises NotUnrollableError if the filter cannot be written out in scalars.
    """
    forward, dt = forward_table(recursion), recursion.system.dt
    backward = backward_table(recursion, forward)
    make_forward, make_backward = forward.make, backward.make
    n_numbers = backward.n_numbers
    _BACKWARD.compile()
    reverse = _BACKWARD.symbol

    def run(theta, records, rows, observed, inputs, t0, tape, terms_bar):
        theta_bar, numbers = np.empty(theta.shape), np.empty(n_numbers)
        places = np.empty((N_OF_LANE, LANES), np.int64)
        arguments = _Arguments(
            forward=make_forward(), table=make_backward(), theta=theta, records=records,
            n_records=theta.shape[0], rows=rows, n_rows=rows.shape[0], observed=observed,
            inputs=inputs, n_input_rows=inputs.shape[0], t0=t0, dt=dt, tape=tape,
            n_taped=tape.shape[0], numbers=numbers, places=places, terms_bar=terms_bar,
            theta_bar=theta_bar,
        )  # fmt: skip
        call_address(address_of(reverse), arguments)
        return theta_bar

    key = key_of(__name__, f"backward pass {dt!r}", forward.key, backward.key, _BACKWARD.key)
    return CompiledFunction(jit(run), key)
