"""A deterministic filter on the records of a panel, side by side in lanes.

Systems too large to be written out in scalars are evaluated record by record.
"""

import numpy as np

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction, jit
from pymc_statespace_filters.compiler.codegen.scalarize import NotUnrollableError
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.filters.gaussian import one_by_one
from pymc_statespace_filters.filters.gaussian.lanes.backward import backward_pass
from pymc_statespace_filters.filters.gaussian.lanes.forward import forward_pass
from pymc_statespace_filters.filters.gaussian.lanes.records import FIND_RECORDS, records_of
from pymc_statespace_filters.filters.gaussian.recursion import GaussianFilterFunctions
from pymc_statespace_filters.filters.outcomes import NONE


def compile_panel(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta (G, k), rows, observed, inputs, t0, seed) -> (terms, health)."""
    try:
        forward = forward_pass(recursion)
    except NotUnrollableError:
        return one_by_one.compile_panel(recursion)
    run = forward.function
    FIND_RECORDS.compile()

    def panel(theta, rows, observed, inputs, t0, seed):
        records, _ = records_of(rows, theta.shape[0], False)
        terms, of_records, _ = run(theta, records, rows, observed, inputs, t0, rows.shape[0], 0)
        return terms, _first_failure(of_records)

    return CompiledFunction(jit(panel), key_of(__name__, "panel", forward.key, FIND_RECORDS.key))


def compile_panel_taped(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """As `compile_panel`, with the tape as third result; it has no rows if any record fails."""
    try:
        forward = forward_pass(recursion)
    except NotUnrollableError:
        return one_by_one.compile_panel_taped(recursion)
    run = forward.function
    FIND_RECORDS.compile()

    def panel(theta, rows, observed, inputs, t0, seed):
        records, n_states = records_of(rows, theta.shape[0], True)
        terms, of_records, tape = run(
            theta, records, rows, observed, inputs, t0, rows.shape[0], n_states
        )
        health = _first_failure(of_records)
        return terms, health, tape[: tape.shape[0] if health[1] == NONE else 0]

    return CompiledFunction(
        jit(panel), key_of(__name__, "taped panel", forward.key, FIND_RECORDS.key)
    )


@jit
def _first_failure(of_records):
    """The health of the first record that fails, or of any."""
    for record in range(of_records.shape[0] - 1):
        if of_records[record, 1] != NONE:
            return of_records[record].copy()
    return of_records[-1].copy()


def compile_panel_pullback(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta, .., seed, tape, terms_bar) -> theta_bar (G, k)."""
    try:
        backward = backward_pass(recursion)
    except NotUnrollableError:
        return one_by_one.compile_panel_pullback(recursion)
    run = backward.function
    FIND_RECORDS.compile()

    def reverse(theta, rows, observed, inputs, t0, seed, tape, terms_bar):
        if tape.shape[0] == 0:
            return np.zeros(theta.shape)
        records, _ = records_of(rows, theta.shape[0], False)
        return run(theta, records, rows, observed, inputs, t0, tape, terms_bar)

    return CompiledFunction(
        jit(reverse), key_of(__name__, "reverse panel", backward.key, FIND_RECORDS.key)
    )


def compile_panel_gradient(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta, .., seed, terms_bar) -> theta_bar."""
    parts = compile_panel_taped(recursion), compile_panel_pullback(recursion)
    taped, reverse = (part.function for part in parts)

    def gradient(theta, rows, observed, inputs, t0, seed, terms_bar):
        _, _, tape = taped(theta, rows, observed, inputs, t0, seed)
        return reverse(theta, rows, observed, inputs, t0, seed, tape, terms_bar)

    large = any(part.large for part in parts)
    key = key_of(__name__, "gradient of a panel", *(part.key for part in parts))
    return CompiledFunction(jit(gradient, large), key, large)
