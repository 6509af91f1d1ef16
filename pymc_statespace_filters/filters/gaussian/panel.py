"""A deterministic filter on many records, side by side in SIMD lanes: see `lane_passes`."""

import numpy as np

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction, jit
from pymc_statespace_filters.compiler.codegen.simd import LANES
from pymc_statespace_filters.compiler.lowering.covariances import covariance_check
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.compiler.native.entry_point import address_of, call_address
from pymc_statespace_filters.filters.gaussian.lane_passes import (
    BACKWARD,
    COUNT_STATES,
    FORWARD,
    N_OF_RECORD,
    SORT_RECORDS,
    BackwardArguments,
    CountArguments,
    ForwardArguments,
    SortArguments,
)
from pymc_statespace_filters.filters.gaussian.lanes import backward_table, forward_table
from pymc_statespace_filters.filters.gaussian.recursion import GaussianFilterFunctions
from pymc_statespace_filters.filters.outcomes import COVARIANCE_NOT_POSITIVE, NONE


def compile_panel(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta (G, k), rows, observed, inputs, t0, seed) -> (terms, health)."""
    taped = _compile_forward(recursion, taped=False)
    forward = taped.function

    def panel(theta, rows, observed, inputs, t0, seed):
        terms, health, _ = forward(theta, rows, observed, inputs, t0)
        return terms, health

    return CompiledFunction(jit(panel), key_of("panel", taped.key))


def compile_panel_taped(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """As `compile_panel`, with the tape as third result; it has no rows if any record fails."""
    taped = _compile_forward(recursion, taped=True)
    forward = taped.function

    def panel(theta, rows, observed, inputs, t0, seed):
        return forward(theta, rows, observed, inputs, t0)

    return CompiledFunction(jit(panel), key_of("panel", taped.key))


def _compile_forward(recursion: GaussianFilterFunctions, *, taped: bool) -> CompiledFunction:
    table, valid = forward_table(recursion), covariance_check(recursion.system)
    make_table, has_valid_covariances = table.make, valid.function
    dt, size = recursion.system.dt, recursion.size
    for entry in (SORT_RECORDS, COUNT_STATES, FORWARD):
        entry.compile()
    sort_records, count_states, run = SORT_RECORDS.symbol, COUNT_STATES.symbol, FORWARD.symbol

    def forward(theta, rows, observed, inputs, t0):
        n_records, n_rows = theta.shape[0], rows.shape[0]
        records = np.empty((n_records, N_OF_RECORD), np.int64)
        sort = SortArguments(rows=rows, n_rows=n_rows, records=records, n_records=n_records)
        call_address(address_of(sort_records), sort)
        used, n_states = np.zeros(1, np.int64), np.zeros(1, np.int64)
        if taped:
            count = CountArguments(
                rows=rows, n_rows=n_rows, records=records, n_records=n_records, n_states=n_states
            )
            call_address(address_of(count_states), count)
        tape = np.empty((n_states[0] * size, LANES))
        terms, of_records = np.empty(n_rows), np.empty((n_records, 3))
        for record in range(n_records):
            is_valid = has_valid_covariances(theta[record].copy())
            of_records[record, 0], of_records[record, 2] = np.inf, -1.0
            of_records[record, 1] = NONE if is_valid else COVARIANCE_NOT_POSITIVE
        arguments = ForwardArguments(
            table=make_table(), theta=theta, records=records, n_records=n_records, rows=rows,
            n_rows=n_rows, observed=observed, inputs=inputs, n_input_rows=inputs.shape[0], t0=t0,
            dt=dt, tape=tape, n_taped=tape.shape[0], terms=terms, health=of_records, used=used,
        )  # fmt: skip
        call_address(address_of(run), arguments)
        health = np.array([np.inf, float(NONE), -1.0])
        n_taped = used[0]
        for record in range(n_records):
            if of_records[record, 1] != NONE:
                health[1], health[2] = of_records[record, 1], of_records[record, 2]
                n_taped = 0
                break
        return terms, health, tape[:n_taped]

    keys = (table.key, valid.key, FORWARD.key)
    return CompiledFunction(jit(forward), key_of(f"forward {dt!r} {size} {taped}", *keys))


def compile_panel_pullback(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta, .., seed, tape, terms_bar) -> theta_bar (G, k)."""
    forward, dt = forward_table(recursion), recursion.system.dt
    backward = backward_table(recursion, forward)
    make_forward, make_backward = forward.make, backward.make
    for entry in (SORT_RECORDS, BACKWARD):
        entry.compile()
    sort_records, run = SORT_RECORDS.symbol, BACKWARD.symbol

    def reverse(theta, rows, observed, inputs, t0, seed, tape, terms_bar):
        theta_bar = np.zeros(theta.shape)
        if tape.size == 0:
            return theta_bar
        n_records, n_rows = theta.shape[0], rows.shape[0]
        records = np.empty((n_records, N_OF_RECORD), np.int64)
        sort = SortArguments(rows=rows, n_rows=n_rows, records=records, n_records=n_records)
        call_address(address_of(sort_records), sort)
        arguments = BackwardArguments(
            forward=make_forward(), table=make_backward(), theta=theta, records=records, n_records=n_records, rows=rows,
            n_rows=n_rows, observed=observed, inputs=inputs, n_input_rows=inputs.shape[0], t0=t0,
            dt=dt, tape=tape, n_taped=tape.shape[0], terms_bar=terms_bar, theta_bar=theta_bar,
        )  # fmt: skip
        call_address(address_of(run), arguments)
        return theta_bar

    keys = (forward.key, backward.key, SORT_RECORDS.key, BACKWARD.key)
    return CompiledFunction(jit(reverse), key_of(f"reverse of a panel {dt!r}", *keys))


def compile_panel_gradient(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta, .., seed, terms_bar) -> theta_bar."""
    parts = compile_panel_taped(recursion), compile_panel_pullback(recursion)
    taped, reverse = (part.function for part in parts)

    def gradient(theta, rows, observed, inputs, t0, seed, terms_bar):
        _, _, tape = taped(theta, rows, observed, inputs, t0, seed)
        return reverse(theta, rows, observed, inputs, t0, seed, tape, terms_bar)

    return CompiledFunction(jit(gradient), key_of("gradient", *(part.key for part in parts)))
