"""The functions of a deterministic filter for several records side by side, one SIMD lane each.

At a single record each step waits for the one before. Further records fill that latency, so several
cost little more than one. The functions are entry points, and `lane_passes` runs them along the
records; it is compiled once for all systems, which it is given as tables.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pytensor.tensor as pt
from numba import carray
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.codegen.function_types import Graph
from pymc_statespace_filters.compiler.codegen.simd import (
    LaneFunction,
    lane_functions,
)
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.compiler.native.entry_point import address_of
from pymc_statespace_filters.compiler.native.jit import njit_internal
from pymc_statespace_filters.filters.gaussian.adjoint import vjps
from pymc_statespace_filters.filters.gaussian.lanes.group import n_numbers
from pymc_statespace_filters.filters.gaussian.recursion import GaussianFilterFunctions


class LaneTable(NamedTuple):
    """Sizes, the first rows of vectors in lanes, and the functions of one pass, see `simd`.

    ``seen`` is 1 in the lanes that observe, else 0. ``term`` holds the term of an update or, on the
    way back, its cotangent. ``prepare`` is called first, with the parameters in their rows: the
    start of the forward pass. ``finish`` ends the backward pass.
    """

    n: int
    size: int
    n_theta: int
    n_inputs: int
    p: int
    d: int
    seen: int
    term: int
    s_bar: int
    c_bar: int
    n_rows: int
    prepare: int
    predict: int
    update: int
    finish: int


SLOTS = LaneTable(*range(len(LaneTable._fields)))


class CompiledTable(NamedTuple):
    """The compiled function () -> table (an array), the key of the functions, and its sizes.

    Calls need ``n_rows`` rows of vectors, and a workspace of ``n_numbers``.
    """

    make: Any
    key: str | None
    n_rows: int
    n_numbers: int


@lru_cache(maxsize=256)
def forward_table(recursion: GaussianFilterFunctions) -> CompiledTable:
    """The forward pass; raises NotUnrollableError where it cannot be written out in scalars."""
    start, predict, update = recursion.start, recursion.predict, recursion.update
    return _table(
        recursion,
        None,
        {
            "start": LaneFunction(start.graph, ["s"]),
            "predict": LaneFunction(predict.graph, ["s"]),
            "update": LaneFunction(_where_it_succeeds(update.graph), ["s", "term"]),
        },
    )


def backward_table(recursion: GaussianFilterFunctions, forward: CompiledTable) -> CompiledTable:
    """The backward pass, which calls functions of the forward pass on the same rows."""
    graphs = {name: _of_lanes(part.graph) for name, part in vjps(recursion, explicit=False).items()}
    theta = graphs["predict_vjp"].inputs["theta"]
    return _table(
        recursion,
        forward,
        {
            "prepare_vjp": LaneFunction(Graph({"theta": theta}, []), []),
            "predict_vjp": LaneFunction(graphs["predict_vjp"], ["s_bar", "c_bar"], backwards=True),
            "update_vjp": LaneFunction(_where_seen(graphs["update_vjp"]), ["s_bar", "c_bar"]),
            "start_vjp": LaneFunction(graphs["start_vjp"], ["c_bar"]),
        },
    )


def _of_lanes(graph: Graph) -> Graph:
    """The state is read from its rows, to which it is copied from the tape."""
    inputs = {"s" if name == "tape" else name: v for name, v in graph.inputs.items()}
    return Graph(inputs, graph.outputs)


def _where_it_succeeds(update: Graph) -> Graph:
    """An update in the lanes that observe; it leaves a state without a finite term as it is."""
    seen, (analysis, term) = _seen(), update.outputs
    succeeds = pt.neq(seen, 0.0) & pt.lt(pt.abs(term[0]), np.inf)
    analysis = pt.switch(succeeds, analysis, update.inputs["s"])
    return Graph({**update.inputs, "seen": seen}, [analysis, term])


def _where_seen(update_vjp: Graph) -> Graph:
    """The cotangents of an update in the lanes that observe; the others keep theirs."""
    seen, inputs = _seen(), update_vjp.inputs
    outputs = [
        pt.switch(pt.neq(seen, 0.0), new, inputs[name])
        for name, new in zip(("s_bar", "c_bar"), update_vjp.outputs, strict=True)
    ]
    return Graph({**inputs, "seen": seen}, outputs)


def _seen() -> TensorVariable:
    return pt.tensor("seen", shape=(), dtype="float64")


def _table(
    recursion: GaussianFilterFunctions,
    before: CompiledTable | None,
    functions: Mapping[str, LaneFunction],
) -> CompiledTable:
    inputs = recursion.update.graph.inputs
    n_theta, n_inputs, p = (inputs[name].type.shape[0] for name in ("theta", "u", "d"))
    size = recursion.size
    lengths = {
        "theta": n_theta, "d": p, "seen": 1, "term": 1, "s_bar": size, "c_bar": n_theta
    }  # fmt: skip
    ends = np.cumsum(list(lengths.values())).tolist()
    rows = dict(zip(lengths, [0, *ends[:-1]], strict=True))
    free = ends[-1] if before is None else before.n_rows
    rows |= {"term_bar": rows["term"]}
    lanes = lane_functions(functions, rows, free, size, n_inputs)
    for entry in lanes.entries.values():
        entry.compile()
    symbols = [entry.symbol for entry in lanes.entries.values()]
    prepare, predict, update, finish = [*symbols, ""][:4]
    n, n_rows = recursion.system.n, lanes.n_rows
    d, seen, term, s_bar, c_bar = (rows[v] for v in ("d", "seen", "term", "s_bar", "c_bar"))

    @njit_internal
    def make():
        table = LaneTable(
            n=n, size=size, n_theta=n_theta, n_inputs=n_inputs, p=p, d=d, seen=seen,
            term=term, s_bar=s_bar, c_bar=c_bar, n_rows=n_rows, prepare=address_of(prepare),
            predict=address_of(predict), update=address_of(update), finish=address_of(finish),
        )  # fmt: skip
        return np.array(table)

    keys = [entry.key for entry in lanes.entries.values()]
    key = key_of(__name__, repr((n, lengths, n_rows)), *keys)
    return CompiledTable(make, key, n_rows, n_numbers(n_rows, size, n_inputs))


@njit_internal
def read_table(table):
    """Unpack a table."""
    t = carray(table, (len(SLOTS),))
    return LaneTable(
        n=t[SLOTS.n], size=t[SLOTS.size], n_theta=t[SLOTS.n_theta], n_inputs=t[SLOTS.n_inputs],
        p=t[SLOTS.p], d=t[SLOTS.d], seen=t[SLOTS.seen],
        term=t[SLOTS.term], s_bar=t[SLOTS.s_bar], c_bar=t[SLOTS.c_bar], n_rows=t[SLOTS.n_rows],
        prepare=t[SLOTS.prepare], predict=t[SLOTS.predict], update=t[SLOTS.update],
        finish=t[SLOTS.finish],
    )  # fmt: skip
