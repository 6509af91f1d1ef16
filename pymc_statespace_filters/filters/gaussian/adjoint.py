"""Exact reverse-mode derivative of a deterministic filter's likelihood, from the forward tape."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.graph.replace import graph_replace
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.codegen.function_types import (
    CompiledFunction,
    Graph,
    VectorFunction,
)
from pymc_statespace_filters.compiler.codegen.functions import copy_elements, vector_functions
from pymc_statespace_filters.filters.gaussian.recursion import (
    GaussianFilterFunctions,
    compile_taped,
    compiled_of,
)
from pymc_statespace_filters.filters.outcomes import is_missing

MAX_EXPLICIT = 8  # states


def compile_pullback(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta, steps, observed, inputs, t0, seed, tape, terms_bar) -> theta_bar."""
    parts = vector_functions(vjps(recursion, explicit=recursion.has_short_rows))
    parameters, zeros, start_vjp, predict_vjp, update_vjp = (
        part.function for part in parts.values()
    )
    dt, n_theta = recursion.system.dt, recursion.system.n_theta
    copy = copy_elements("c_bar, theta_bar", "theta_bar[{i}]", "c_bar", n_theta)

    def reverse(theta, steps, observed, inputs, t0, seed, tape, terms_bar):
        theta_bar = np.zeros(theta.size)
        row = np.uint64(tape.shape[0])  # unsigned: spares the check for negative indices
        if row == 0:
            return theta_bar
        c = parameters(theta)
        s_bar, c_bar = zeros(c)
        k = steps[-1]
        for j in range(steps.size - 1, -1, -1):
            row -= np.uint64(1)
            if not is_missing(observed, j):
                s_bar, c_bar = update_vjp(
                    c, inputs, k, t0 + k * dt, observed[j], tape, row, s_bar, terms_bar[j], c_bar
                )
            first = steps[j - 1] if j else 0
            while k > first:
                k -= 1
                row -= np.uint64(1)
                s_bar, c_bar = predict_vjp(c, inputs, k, t0 + k * dt, tape, row, s_bar, c_bar)
        c_bar = start_vjp(c, s_bar, c_bar)
        copy(c_bar, theta_bar)
        return theta_bar

    return compiled_of(reverse, "reverse", parts, recursion)


def compile_gradient(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta, steps, observed, inputs, t0, seed, terms_bar) -> theta_bar."""
    parts = {"taped": compile_taped(recursion), "reverse": compile_pullback(recursion)}
    taped, reverse = (part.function for part in parts.values())

    def gradient(theta, steps, observed, inputs, t0, seed, terms_bar):
        _, _, tape = taped(theta, steps, observed, inputs, t0, seed)
        return reverse(theta, steps, observed, inputs, t0, seed, tape, terms_bar)

    return compiled_of(gradient, "gradient", parts, recursion)


def vjps(recursion: GaussianFilterFunctions, *, explicit: bool) -> dict[str, VectorFunction]:
    """Vector-Jacobian products of the three parts; each adds to ``c_bar``, theta's cotangent.

    They are linear in the cotangent, which is their only input from the later step. If ``explicit``,
    the rows of the Jacobian for the first elements of the cotangent are computed explicitly: the
    processor does so ahead of time, and the cotangent then takes one multiplication. The other
    elements are propagated through the equations, with fewer operations in all. The numbers of
    explicit elements were chosen by measurement: with ten states rows no longer pay, and twenty
    would take 15 s to write out. A linearisation that evaluates the equations at many points has
    none, because each row is as long as a propagation, and records side by side have none, because
    they fill the time in which a single one waits.
    """
    theta, s = (recursion.predict.graph.inputs[name] for name in ("theta", "s"))
    s_bar, c_bar = s.type("s_bar"), theta.type("c_bar")
    term_bar = pt.tensor("term_bar", shape=(), dtype="float64")
    n, size = recursion.system.n, recursion.size
    of_predict, of_update = size if n == 1 else n, size + 1 if n <= 2 else 0
    if n > MAX_EXPLICIT:
        of_predict = 0
    if not explicit:
        of_predict = of_update = 0

    def vjp(part: VectorFunction, wrt: list, cotangents: dict, n_explicit: int) -> VectorFunction:
        values = list(cotangents.values())
        *states_bar, theta_bar = _pullback(part.graph.outputs, values, wrt, n_explicit)
        given = {"tape" if v is s else name: v for name, v in part.graph.inputs.items()}
        inputs = {**given, **cotangents, "c_bar": c_bar}
        return VectorFunction(
            ", ".join([part.arguments.replace(", s", ", tape, row"), *cotangents, "c_bar"]),
            Graph(inputs, [*states_bar, c_bar + theta_bar]),
            [False] * len(wrt),
        )

    zeros = [pt.zeros(v.type.shape) for v in (s, theta)]
    state, state_and_term = {"s_bar": s_bar}, {"s_bar": s_bar, "term_bar": term_bar}
    return {
        "parameters": recursion.parts()["parameters"],
        "zeros": VectorFunction("c", Graph({"theta": theta}, zeros), (False, False)),
        "start_vjp": vjp(recursion.start, [theta], state, 0),
        "predict_vjp": vjp(recursion.predict, [s, theta], state, of_predict),
        "update_vjp": vjp(recursion.update, [s, theta], state_and_term, of_update),
    }


def _pullback(
    outputs: Sequence[TensorVariable],
    cotangents: Sequence[TensorVariable],
    wrt: Sequence[TensorVariable],
    n_explicit: int,
) -> list[TensorVariable]:
    """Vector-Jacobian products, the first elements of the cotangents by explicit Jacobian rows."""
    cotangent = pt.concatenate([pt.atleast_1d(c) for c in cotangents])
    symbol = cotangent.type("cotangent")
    ends = np.cumsum([output.type.shape[0] for output in outputs])
    pieces = [symbol[end - o.type.shape[0] : end] for o, end in zip(outputs, ends, strict=True)]
    bars = pytensor.grad(
        None,
        wrt,
        known_grads=dict(zip(outputs, pieces, strict=True)),
        disconnected_inputs="ignore",
        return_disconnected="zero",
    )
    bars = [pt.specify_shape(b, w.type.shape) for b, w in zip(bars, wrt, strict=True)]

    def at(value: Any) -> list[TensorVariable]:
        return graph_replace(bars, {symbol: pt.as_tensor(value)}, strict=False)

    if not n_explicit:
        return at(cotangent)
    totals = at(pt.concatenate([np.zeros(n_explicit), cotangent[n_explicit:]]))
    for i in reversed(range(n_explicit)):
        row = at(np.eye(ends[-1])[i])
        totals = [total + cotangent[i] * entry for total, entry in zip(totals, row, strict=True)]
    return totals
