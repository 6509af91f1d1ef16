"""Compiled functions without a plan: those of users' own filters, and simulations.

A function with a plan checks the record that it is given, and takes a panel as it takes a single
record. For the others, both are done here.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, Protocol

import numpy as np
from numba import typeof

from ..compiler.codegen.function_types import CompiledFunction, jit
from ..compiler.native.cache_key import key_of
from ..compiler.native.entry_point import cached_on_disk
from ..compiler.native.plan import (
    INPUT_COLUMNS,
    INPUT_ROWS,
    OBSERVED,
    PANEL_COLUMNS,
    PANEL_RECORDS,
    PANEL_STEPS,
    REFUSALS,
    STEPS,
)
from ..compiler.numerics.philox import seed_of_record
from ..errors import ModelError
from ..filters.calls import include_health
from ..filters.outcomes import NONE
from ..filters.protocol import Compiled, Filter
from ..filters.signatures import Names
from ..parallel.signals import held_interrupts
from ..progress import slow_compilation
from ..system.model import StateSpaceModel
from ..system.panel_records import FIRST_INPUT, N_COLUMNS, RECORD, STEP

# Arguments that such a function does not read: it is neither replaced nor divided between ranks.
_OF_PLANS = {"rank", "n_ranks", "exchange", "number", "replacement"}


class FilterOp(Protocol):
    """What is read of a `base.FilterOp`."""

    system: StateSpaceModel
    filter: Filter
    arguments: Names
    takes_noise: Any


def check_record(system: StateSpaceModel) -> Any:
    """A compiled check of steps and inputs."""
    return _check_of_inputs(system.n_input_columns, int(system.observation_uses_inputs))


# Made once for all systems of one shape: a fresh one would be compiled by the next call.
@cache
def _check_of_inputs(n_columns: int, last_row: int) -> Any:
    wrong_steps, wrong_columns, too_few = (REFUSALS[i] for i in (STEPS, INPUT_COLUMNS, INPUT_ROWS))

    @jit
    def check(steps, inputs):
        for j in range(steps.size):
            if steps[j] < 0 or (j > 0 and steps[j] <= steps[j - 1]):
                raise ModelError(wrong_steps)
        if n_columns and inputs.shape[1] != n_columns:
            raise ModelError(wrong_columns)
        if n_columns and steps.size and inputs.shape[0] < steps[-1] + last_row:
            raise ModelError(too_few)

    return check


def check_panel(system: StateSpaceModel) -> Any:
    """A compiled check of the rows of a panel, see `system.panel`."""
    return _check_of_rows(system.n_input_columns, int(system.observation_uses_inputs))


@cache
def _check_of_rows(n_columns: int, last_row: int) -> Any:
    no_rows, wrong_columns = REFUSALS[PANEL_COLUMNS], REFUSALS[INPUT_COLUMNS]
    wrong_steps, too_few = REFUSALS[PANEL_STEPS], REFUSALS[INPUT_ROWS]
    wrong_records = REFUSALS[PANEL_RECORDS]

    @jit
    def check(theta, rows, inputs):
        if rows.shape[1] != N_COLUMNS:
            raise ModelError(no_rows)
        if n_columns and inputs.shape[1] != n_columns:
            raise ModelError(wrong_columns)
        n_records = 0
        for j in range(rows.shape[0]):
            begins = j == 0 or rows[j, RECORD] != rows[j - 1, RECORD]
            n_records += begins
            if rows[j, STEP] < 0 or (not begins and rows[j, STEP] <= rows[j - 1, STEP]):
                raise ModelError(wrong_steps)
            if n_columns and inputs.shape[0] < rows[j, FIRST_INPUT] + rows[j, STEP] + last_row:
                raise ModelError(too_few)
        if n_records != theta.shape[0]:
            raise ModelError(wrong_records)

    return check


@cache
def _check_observed(p: int) -> Any:
    wrong_shape = REFUSALS[OBSERVED]

    @jit
    def check(steps, observed):
        if observed.shape[0] != steps.shape[0] or observed.shape[1] != p:
            raise ModelError(wrong_shape)

    return check


def cache_key(system: StateSpaceModel, compiled: Compiled) -> str | None:
    """The key of a compiled function together with the checks of its record."""
    checked = (system.p, system.n_input_columns, system.observation_uses_inputs)
    return key_of(__name__, f"checked for {checked}", compiled.key)


def jitted(op: FilterOp, kernel: CompiledFunction) -> Callable:
    """The checked call from Python; its code is on disk if it has a key."""
    function, key = checked_call(op, kernel)
    machine_code = cached_on_disk(jit(function), key)

    def call(*arrays: np.ndarray) -> Any:
        if not machine_code.overloads:
            with held_interrupts(), slow_compilation(f"{type(op.filter).__name__} for this system"):
                machine_code.compile(tuple(map(typeof, arrays)))
        return machine_code(*arrays)

    return call


def checked_call(op: FilterOp, compiled: CompiledFunction) -> tuple[Any, str | None]:
    """The function that checks the record, then calls a compiled one; and its key.

    Kernels receive copies: constants and variables, C and Fortran order differ in type, and each
    combination of types would be compiled separately, which takes seconds where a copy takes
    nanoseconds. The function is written out for each operation; a loop over the inputs would cost
    time in every call and seconds of compilation.
    """
    ndims = dict(op.arguments)
    checks = ["check_observed(steps, observed)"]
    checks.append(
        "check(steps, inputs)" if ndims["steps"] == 1 else "check_panel(theta, steps, inputs)"
    )
    if "tape" in ndims:  # which was made by an operation that checked the record
        checks = []
    codes = {n: f"{n}.copy()" if ndim else f"{n}.item()" for n, ndim in op.arguments}
    if "tape" in codes:
        codes["tape"] = "tape"
    if op.takes_noise:
        seed, normals = codes.pop("seed", "np.int64(0)"), "no_normals.copy()"
        if codes.pop("normals", None):
            normals = "np.ascontiguousarray(normals)"  # not copied: they are many
        codes["noise"] = f"({seed}, {normals})"
    arguments = ", ".join(code for name, code in codes.items() if name not in _OF_PLANS)
    lines = [*checks, f"return run({arguments})"]
    source = f"def call({', '.join(ndims)}):\n" + "".join(f"    {line}\n" for line in lines)
    namespace = {
        "__name__": __name__,
        "np": np,
        "run": compiled.function,
        "check": check_record(op.system),
        "check_panel": check_panel(op.system),
        "check_observed": _check_observed(op.system.p),
        "no_normals": np.empty(0),
    }
    exec(compile(source, f"<call of {type(op).__name__}>", "exec"), namespace)
    key = cache_key(op.system, compiled)
    return namespace["call"], key_of(__name__, source, key)


@jit
def end_of_record(rows, first):
    """The row behind the record that begins in row ``first``."""
    last = first + 1
    while last < rows.shape[0] and rows[last, RECORD] == rows[first, RECORD]:
        last += 1
    return last


@jit
def single_record(theta, rows, observed, inputs, record, first, last):
    """Parameters, steps, data and inputs of the record in these rows, as a single one has them."""
    return (
        theta[record].copy(),
        rows[first:last, STEP].copy(),
        observed[first:last],
        inputs[rows[first, FIRST_INPUT] :],
    )


def values_one_by_one(value: CompiledFunction) -> CompiledFunction:
    """The likelihood of a panel by that of a single record."""
    run = value.function

    def panel(theta, rows, observed, inputs, t0, noise):
        seed, normals = noise
        terms = np.empty(rows.shape[0])
        health = np.array([np.inf, float(NONE), -1.0])
        first = 0
        for record in range(theta.shape[0]):
            last = end_of_record(rows, first)
            terms[first:last], of_record = run(
                *single_record(theta, rows, observed, inputs, record, first, last),
                t0,
                (seed_of_record(seed, rows[first, RECORD]), normals),
            )
            include_health(health, of_record, first)
            first = last
        return terms, health

    key = key_of(__name__, "panel", value.key)
    return CompiledFunction(jit(panel, value.large), key, value.large)


def gradients_one_by_one(gradient: CompiledFunction) -> CompiledFunction:
    """The vector-Jacobian product of a panel by that of a single record."""
    run = gradient.function

    def panel(theta, rows, observed, inputs, t0, seed, terms_bar):
        theta_bar = np.empty(theta.shape)
        first = 0
        for record in range(theta.shape[0]):
            last = end_of_record(rows, first)
            theta_bar[record] = run(
                *single_record(theta, rows, observed, inputs, record, first, last),
                t0,
                seed,
                terms_bar[first:last],
            )
            first = last
        return theta_bar

    key = key_of(__name__, "gradient of a panel", gradient.key)
    return CompiledFunction(jit(panel, gradient.large), key, gradient.large)
