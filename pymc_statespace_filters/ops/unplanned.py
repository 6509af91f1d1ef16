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
from ..compiler.native.plan import Refusal
from ..compiler.numerics.philox import seed_of_record
from ..errors import ModelError
from ..filters.calls import include_health, status_of_rows
from ..filters.outcomes import NONE
from ..filters.protocol import Compiled, Filter
from ..filters.signatures import Names
from ..parallel.signals import held_interrupts
from ..progress import slow_compilation
from ..system.model import StateSpaceModel
from ..system.panel_records import FIRST_INPUT, RECORD, STEP

# Arguments that such a function does not read: it is neither replaced nor divided between ranks.
_OF_PLANS = {"rank", "n_ranks", "exchange", "number", "replacement"}


class FilterOp(Protocol):
    """What is read of a `base.FilterOp`."""

    system: StateSpaceModel
    filter: Filter
    arguments: Names
    takes_noise: Any


def check_of_rows(system: StateSpaceModel, *, of_panel: bool) -> Any:
    """A compiled check of theta, the steps or the rows of a panel, and inputs."""
    return _check_of_rows(system.n_input_columns, int(system.observation_uses_inputs), of_panel)


# Made once for all systems of one shape: a fresh one would be compiled by the next call.
@cache
def _check_of_rows(n_inputs: int, last_row: int, of_panel: bool) -> Any:
    @jit
    def check_steps(theta, steps, inputs):
        n_rows, n_columns = inputs.shape
        _refuse(status_of_rows(steps, 1, 1, n_rows, n_columns, n_inputs, last_row))

    @jit
    def check_panel(theta, rows, inputs):
        n_rows, n_columns = inputs.shape
        width, table = rows.shape[1], rows.copy().reshape(rows.size)
        _refuse(status_of_rows(table, width, theta.shape[0], n_rows, n_columns, n_inputs, last_row))

    return check_panel if of_panel else check_steps


@cache
def _check_of_data(p: int) -> Any:
    of_data = int(Refusal.OBSERVED)

    @jit
    def check(steps, observed):
        if observed.shape[0] != steps.shape[0] or observed.shape[1] != p:
            _refuse(of_data)

    return check


def _refusal() -> Any:
    """A compiled function that raises what a status says."""
    lines = [f"if status == {int(r)}: raise ModelError({r.message!r})" for r in Refusal]
    scope = {"ModelError": ModelError}
    exec("def refuse(status):\n" + "".join(f"    {line}\n" for line in lines), scope)
    return jit(scope["refuse"])


_refuse = _refusal()


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
    # A tape was made by an operation that checked the record.
    is_checked = "tape" in ndims
    checks = [] if is_checked else ["check(theta, steps, inputs)", "check_data(steps, observed)"]
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
        "check": check_of_rows(op.system, of_panel=ndims["steps"] == 2),
        "check_data": _check_of_data(op.system.p),
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
