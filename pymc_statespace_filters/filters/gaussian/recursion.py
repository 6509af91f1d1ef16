"""The forward pass of a deterministic filter, compiled: one vector ``s`` carried along a record.

The filter is given as graphs of three functions of that vector. The likelihood takes one pass; for
a derivative the pass also leaves a tape of its states, which `adjoint` reads.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pymc_statespace_filters.compiler.codegen.function_types import (
    CompiledFunction,
    Graph,
    VectorFunction,
    jit,
)
from pymc_statespace_filters.compiler.codegen.functions import (
    all_finite,
    copy_elements,
    vector_functions,
)
from pymc_statespace_filters.compiler.lowering.covariances import covariance_check
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.filters.outcomes import (
    COVARIANCE_NOT_POSITIVE,
    NO_FINITE_MEMBER,
    NONE,
    is_missing,
)
from pymc_statespace_filters.system.model import StateSpaceModel


@dataclass(frozen=True, eq=False)
class GaussianFilterFunctions:
    """A filter's functions for one system; the first ``system.n`` entries of s are the mean.

    * ``start(c) -> s`` at step 0; ``c`` are the parameters.
    * ``predict(c, inputs, k, t, s) -> s`` from step k to k + 1.
    * ``update(c, inputs, k, t, d, s) -> (s, term)`` with log p(d_j | d_1 .. d_{j-1}).

    ``has_short_rows`` says whether a row of the Jacobian of a prediction takes few operations.
    """

    system: StateSpaceModel
    has_short_rows: bool
    start: VectorFunction
    predict: VectorFunction
    update: VectorFunction

    @property
    def size(self) -> int:
        """Length of s."""
        return self.predict.graph.inputs["s"].type.shape[0]

    def parts(self) -> dict[str, VectorFunction]:
        """The functions of the forward pass; parameters are read once, before its loop."""
        theta = self.start.graph.inputs["theta"]
        return {
            "parameters": VectorFunction("c", Graph({"theta": theta}, [theta])),
            "start": self.start,
            "predict": self.predict,
            "update": self.update,
        }


@dataclass(frozen=True)
class _Tape:
    """How the forward pass stores its states: ``new`` allocates, ``save`` writes a row."""

    new: Any
    save: Any
    result: Any


def _tape(size: int) -> _Tape:
    """A row for the state before each prediction and each update; no rows if the filter fails."""

    def new(steps):
        n_steps = steps[-1] if steps.size else 0
        return np.empty((n_steps + steps.size, size))

    save = copy_elements("tape, row, s", "tape[row, {i}]", "s", size)

    def result(terms, health, tape, row, s):
        return terms, health, tape[: row if health[1] == NONE else 0]

    return _Tape(jit(new), save, jit(result))


def _tape_to_the_end(size: int) -> _Tape:
    """As `_tape`, with the last state as last row; rows from a failing observation on are NaN."""
    save = _tape(size).save

    def new(steps):
        n_steps = steps[-1] if steps.size else 0
        return np.full((n_steps + steps.size + 1, size), np.nan)

    def result(terms, health, tape, row, s):
        if health[1] == NONE:
            save(tape, row, s)
        elif row > 0:
            tape[row - 1] = np.nan
        return terms, health, tape

    return _Tape(jit(new), save, jit(result))


def compile_value(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta, steps, observed, inputs, t0, seed) -> (terms, health)."""
    no_tape = _Tape(
        jit(lambda steps: None),
        jit(lambda tape, row, s: None),
        jit(lambda terms, health, tape, row, s: (terms, health)),
    )
    return _compile_forward(recursion, "value", no_tape)


def compile_taped(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """As `compile_value`, with the tape as third result."""
    return _compile_forward(recursion, "taped", _tape(recursion.size))


def compile_taped_to_the_end(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """As `compile_taped`; the tape also holds the last state, and is kept if the filter fails."""
    return _compile_forward(recursion, "taped to the end", _tape_to_the_end(recursion.size))


def _compile_forward(
    recursion: GaussianFilterFunctions, what: str, tape: _Tape
) -> CompiledFunction:
    parts = vector_functions(recursion.parts())
    parameters, start, predict, update = (part.function for part in parts.values())
    valid = covariance_check(recursion.system)
    has_valid_covariances = valid.function
    dt, has_finite_mean = recursion.system.dt, all_finite(recursion.system.n)
    is_finite = all_finite(recursion.size)
    new, save, result = tape.new, tape.save, tape.result

    def forward(theta, steps, observed, inputs, t0, seed):
        terms = np.full(steps.size, -np.inf)
        health = np.array([np.inf, float(NONE), -1.0])
        states = new(steps)
        if not has_valid_covariances(theta):
            health[1], health[2] = COVARIANCE_NOT_POSITIVE, 0.0
            return result(terms, health, states, 0, np.empty(0))
        c = parameters(theta)
        s = start(c)
        k, row = 0, 0
        for j in range(steps.size):
            while k < steps[j]:
                save(states, row, s)
                s = predict(c, inputs, k, t0 + k * dt, s)
                k += 1
                row += 1
            save(states, row, s)
            row += 1
            if is_missing(observed, j):
                terms[j] = 0.0
                continue
            has_mean, finite = has_finite_mean(s), is_finite(s)
            s, terms[j] = update(c, inputs, k, t0 + k * dt, observed[j], s)
            # A state that no observation depends on may be NaN where the term is finite.
            if not (finite and np.isfinite(terms[j])):
                terms[j:] = -np.inf
                health[1] = COVARIANCE_NOT_POSITIVE if has_mean else NO_FINITE_MEMBER
                health[2] = j
                break
        return result(terms, health, states, row, s)

    return compiled_of(forward, what, parts | {"valid": valid}, recursion)


def compiled_of(
    function: Any,
    what: str,
    parts: Mapping[str, CompiledFunction],
    recursion: GaussianFilterFunctions,
) -> CompiledFunction:
    """Compile a function that calls these parts; its key includes theirs."""
    what = f"{what} {recursion.system.dt!r} {recursion.system.n}"
    large = any(part.large for part in parts.values())
    key = key_of(__name__, function, what, *(part.key for part in parts.values()))
    return CompiledFunction(jit(function, large), key, large)
