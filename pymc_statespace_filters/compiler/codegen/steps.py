"""Functions of a filter for one record: its steps and rows along a record, or each on its own.

Along a record the state is in registers, see `record_loops`. The others are called as the functions
of many records are, see `simd`, with one lane. Those that cannot be written out in scalars call
array code.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray

from ..native.entry_point import EntryPoint
from ..native.jit import njit_internal
from .arguments import ALONG_ARGUMENTS, LANE_ARGUMENTS
from .array_fallback import array_code, used_inputs
from .emitter import Emitter
from .expressions import Value
from .function_types import function_of
from .functions import log_choice, unrolled
from .machine_code import Module, ModuleEntryPoint, constant
from .record_loops import Sizes, backward_loop, forward_loop
from .scalarize import NotUnrollableError
from .simd import (
    INPUTS,
    NOISE,
    STATE,
    TIME,
    LaneFunction,
    Places,
    Written,
    length_of,
    sizes_of,
    written_out,
)


def step_functions(
    functions: Mapping[str, LaneFunction], places: Places, along: tuple[str, str, str]
) -> tuple[dict[str, EntryPoint], int]:
    """Entry points, and the number of rows of ``W``.

    Those with `LANE_ARGUMENTS` make one step in one lane. The first function also computes what the
    others need of parameters alone, see `simd`. ``along`` names the functions of a step and of a
    row, and the entry point with `ALONG_ARGUMENTS` that takes their place.
    """
    values = {name: _unrolled(name, function) for name, function in functions.items()}
    first = next(iter(functions))
    in_scalars = {name: v or [] for name, v in values.items()}
    # Array code computes nothing for others.
    shares = values[first] is not None
    written, n_rows = written_out(functions, in_scalars, places, shares=shares)
    entries: dict[str, EntryPoint] = {}
    *pair, name_along = along
    for name, function in functions.items():
        if name in pair:
            continue
        if values[name] is None:
            entries[name] = _on_arrays(name, function, places)
        else:
            entries[name] = _in_scalars(name, places, written[name])
    step, row = (functions[name] for name in pair)
    if any(values[name] is None for name in pair):
        entries[name_along] = _along_on_arrays(name_along, step, row, places)
    else:
        carried = [f"{name}.{i}" for name, n in sizes_of(step) for i in range(n)]
        loop = backward_loop if step.backwards else forward_loop
        sizes = _sizes_along(step, places)
        code = loop(written[pair[0]], written[pair[1]], carried, sizes)
        entries[name_along] = ModuleEntryPoint(code, ALONG_ARGUMENTS, name_along)
    return entries, n_rows


def _sizes_along(step: LaneFunction, places: Places) -> Sizes:
    result = places.rows["s_bar" if step.backwards else "term"]
    return Sizes(places.state_size, places.n_inputs, places.n_noises, places.n_observables, result)


def _unrolled(name: str, function: LaneFunction) -> list[Value] | None:
    try:
        values = [v for group in unrolled(function.graph) for v in group]
    except NotUnrollableError as reason:
        log_choice(name, reason)
        return None
    log_choice(name)
    return values


def _in_scalars(name: str, places: Places, written: Written) -> EntryPoint:
    """A function of one step, written out in scalars."""
    module = Module()
    build, given = module.main(LANE_ARGUMENTS)

    def read(element: str) -> ir.Value:
        vector, _, i = element.partition(".")
        if vector == TIME:
            step = build.sitofp(given["k"], given["t0"].type)
            elapsed = emitter.arithmetic("fmul", step, given["dt"])
            return emitter.arithmetic("fadd", given["t0"], elapsed)
        array, first = places.of(vector)
        return build.load(build.gep(given[array], [constant(first + int(i))]))

    emitter = Emitter(module, build, read, vector=False)
    for value, row in written.known.items():
        emitter.set(value, build.load(build.gep(given["W"], [constant(row)])))
    results = emitter.floats(written.values)
    for (array, i), result in zip(written.targets, results, strict=True):
        build.store(result, build.gep(given[array], [constant(i)]))
    build.ret_void()
    return ModuleEntryPoint(module.finished(), LANE_ARGUMENTS, name)


@njit_internal
def vector_at(address, first, size):
    """A copy of some numbers at an address."""
    return carray(address, (first + size,))[first:].copy()


@njit_internal
def write(address, first, values):
    """Write a vector of numbers behind an address."""
    out = carray(address, (first + values.size,))
    for i in range(values.size):
        out[first + i] = values[i]


_ARRAY_ARGUMENTS = "W, states, forces, observed, inputs, noises, terms, at, k, j, t"


def _array_step(
    function: LaneFunction, places: Places, *, along: bool = False
) -> tuple[Any, str, str | None]:
    """A function that calls array code, its source, and the key of this; NaN where that raises.

    The state is read at the place ``at``, and the next one is written behind it.
    """
    graph = function.graph
    used = used_inputs(graph.inputs, graph.outputs)
    compiled = array_code(list(used.values()), graph.outputs)
    elsewhere = {STATE: ("states", "at")}
    if along:
        elsewhere |= {
            INPUTS: ("inputs", f"k * {places.n_inputs}"),
            NOISE: ("noises", f"k * {places.n_noises}"),
            "d": ("observed", f"j * {places.n_observables}"),
            "term_bar": ("terms", "j"), "term": ("terms", "j"),
        }  # fmt: skip
    given = []
    for name, variable in used.items():
        array, first = elsewhere.get(name) or places.of(name) if name != TIME else ("", "")
        value = f"vector_at({array}, {first}, {length_of(variable)})"
        value = value if variable.type.ndim else f"np.asarray({value}[0])"
        given.append("np.asarray(t)" if name == TIME else value)
    writes, failed = ["    pass"], ["    pass"]
    for n, (name, length) in enumerate(sizes_of(function)):
        array, first = elsewhere.get(name) or places.of(name)
        first = f"{first} + {places.state_size}" if name == STATE else first
        writes.append(f"    write({array}, {first}, out[{n}])")
        failed.append(f"    write({array}, {first}, np.full({length}, nan))")
    body = [
        "try:",
        f"    out = array_code({', '.join(given)})",
        *writes,
        "except Exception:",  # a singular matrix, say
        *failed,
    ]
    scope = {
        "np": np, "nan": np.nan, "array_code": compiled.function, "vector_at": vector_at,
        "write": write,
    }  # fmt: skip
    step, source = function_of("step", _ARRAY_ARGUMENTS, body, scope)
    return step, source, compiled.key


def _on_arrays(name: str, function: LaneFunction, places: Places) -> EntryPoint:
    """A function of one step that calls array code."""
    step, *parts = _array_step(function, places)

    def run(W, n_lanes, states, forces, t0, dt, k, n_steps):
        step(W, states, forces, W, W, W, W, 0, k, 0, t0 + k * dt)

    return EntryPoint(run, LANE_ARGUMENTS, name, parts)


def _along_on_arrays(
    name: str, step: LaneFunction, row: LaneFunction, places: Places
) -> EntryPoint:
    """The loops along a record, with array code for a step and a row."""
    at_step, *of_step = _array_step(step, places, along=True)
    at_row, *of_row = _array_step(row, places, along=True)
    size, p = places.state_size, places.n_observables

    def forward(
        W, steps, row_width, n_rows, first, observed, inputs, noises, states, stride, t0, dt, terms
    ):  # fmt: skip
        k, at = first, 0
        for j in range(n_rows):
            while k < steps[j * row_width]:
                at_step(W, states, W, observed, inputs, noises, terms, at, k, j, t0 + k * dt)
                at = _next(states, at, size, stride)
                k += 1
            if _is_missing(observed, j, p):
                terms[j] = 0.0
                write(states, at + size, vector_at(states, at, size))
            else:
                at_row(W, states, W, observed, inputs, noises, terms, at, k, j, t0 + k * dt)
                # A state that no observation depends on may be NaN where the term is finite.
                if not (np.isfinite(terms[j]) and _is_finite(states, at, size)):
                    W[result] = j
                    return
            at = _next(states, at, size, stride)
        W[result] = n_rows

    result, n_bars = _sizes_along(step, places).result, sum(n for _, n in sizes_of(step))

    def backward(
        W, steps, row_width, n_rows, first, observed, inputs, noises, states, stride, t0, dt, terms
    ):  # fmt: skip
        write(W, result, np.zeros(n_bars))
        k = steps[(n_rows - 1) * row_width]
        at = (k + n_rows) * size
        for j in range(n_rows - 1, -1, -1):
            at -= size
            if not _is_missing(observed, j, p):
                at_row(W, states, W, observed, inputs, noises, terms, at, k, j, t0 + k * dt)
            origin = steps[(j - 1) * row_width] if j else 0
            while k > origin:
                k -= 1
                at -= size
                at_step(W, states, W, observed, inputs, noises, terms, at, k, j, t0 + k * dt)

    run = backward if step.backwards else forward
    return EntryPoint(run, ALONG_ARGUMENTS, name, (repr(places), *of_step, *of_row))


@njit_internal
def _is_missing(observed, j, p):
    for value in vector_at(observed, j * p, p):
        if not np.isnan(value):
            return False
    return True


@njit_internal
def _next(states, at, size, stride):
    """The place of the next state, to which it is moved if it is on the same place."""
    if stride == 0:
        write(states, at, vector_at(states, at + size, size))
    return at + stride


@njit_internal
def _is_finite(states, at, size):
    for value in vector_at(states, at, size):
        if not np.isfinite(value):
            return False
    return True
