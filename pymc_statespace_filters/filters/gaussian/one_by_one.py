"""Records or points one after the other, by the functions of a single record."""

import numpy as np

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction, jit
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.filters.gaussian.adjoint import compile_pullback
from pymc_statespace_filters.filters.gaussian.recursion import (
    GaussianFilterFunctions,
    compile_taped,
    compile_value,
)
from pymc_statespace_filters.filters.outcomes import NONE
from pymc_statespace_filters.filters.records import end_of_record, include_health, single_record
from pymc_statespace_filters.system.panel import RECORD, STEP


def compile_batch(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta (B, k), steps, observed, inputs, t0, seed) -> terms, health."""
    value = compile_value(recursion)
    run = value.function

    def batch(theta, steps, observed, inputs, t0, seed):
        terms, health = np.empty((theta.shape[0], steps.size)), np.empty((theta.shape[0], 3))
        for i in range(theta.shape[0]):
            terms[i], health[i] = run(theta[i].copy(), steps, observed, inputs, t0, seed)
        return terms, health

    return _compiled(batch, "batch one by one", value)


def compile_panel(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta (G, k), rows, observed, inputs, t0, seed) -> (terms, health)."""
    value = compile_value(recursion)
    run = value.function

    def panel(theta, rows, observed, inputs, t0, seed):
        terms, health = np.empty(rows.shape[0]), np.array([np.inf, float(NONE), -1.0])
        last = 0
        for record in range(theta.shape[0]):
            first, last = last, end_of_record(rows, last)
            terms[first:last], of_record = run(
                *single_record(theta, rows, observed, inputs, record, first, last),
                t0,
                seed,
            )
            include_health(health, of_record, first)
        return terms, health

    return _compiled(panel, "panel one by one", value)


def compile_panel_taped(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """As `compile_panel`, with the tapes one below the other; no rows if any record fails."""
    taped, size = compile_taped(recursion), recursion.size
    run = taped.function

    def panel(theta, rows, observed, inputs, t0, seed):
        terms, health = np.empty(rows.shape[0]), np.array([np.inf, float(NONE), -1.0])
        tape = np.empty((_n_taped(rows, 0, rows.shape[0]), size))
        last, end = 0, 0
        for record in range(theta.shape[0]):
            first, last = last, end_of_record(rows, last)
            terms[first:last], of_record, own = run(
                *single_record(theta, rows, observed, inputs, record, first, last),
                t0,
                seed,
            )
            include_health(health, of_record, first)
            tape[end : end + own.shape[0]] = own
            end += own.shape[0]
        return terms, health, tape[: end if health[1] == NONE else 0]

    return _compiled(panel, f"taped panel one by one {size}", taped)


def compile_panel_pullback(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta, .., seed, tape, terms_bar) -> theta_bar (G, k)."""
    pullback = compile_pullback(recursion)
    run = pullback.function

    def reverse(theta, rows, observed, inputs, t0, seed, tape, terms_bar):
        theta_bar = np.zeros(theta.shape)
        if tape.shape[0] == 0:
            return theta_bar
        last, end = 0, 0
        for record in range(theta.shape[0]):
            first, last = last, end_of_record(rows, last)
            begin, end = end, end + _n_taped(rows, first, last)
            theta_bar[record] = run(
                *single_record(theta, rows, observed, inputs, record, first, last),
                t0,
                seed,
                tape[begin:end],
                terms_bar[first:last],
            )
        return theta_bar

    return _compiled(reverse, "reverse panel one by one", pullback)


@jit
def _n_taped(rows, first, last):
    """The rows of the tapes of whole records: one for each of their steps and rows."""
    total = last - first
    for row in range(first, last):
        if row + 1 == last or rows[row + 1, RECORD] != rows[row, RECORD]:
            total += rows[row, STEP]
    return total


def _compiled(function, what: str, part: CompiledFunction) -> CompiledFunction:
    return CompiledFunction(jit(function, part.large), key_of(__name__, what, part.key), part.large)
