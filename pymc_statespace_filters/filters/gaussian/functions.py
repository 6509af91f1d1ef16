"""The machine code of a deterministic filter for one system: entry points in one of three forms.

A filter is graphs of three functions of one vector ``s``, carried along a record. The likelihood
takes one pass; for a derivative the pass also leaves a tape of its states, along which their
vector-Jacobian products go back.

At a single record each step waits for the one before. Further records fill that latency, so several
cost little more than one. The functions therefore have a form for one record, with its state in
registers, and one for several side by side, a SIMD lane each, which takes longer for one. Those
that are too large to be written out in scalars call array code, for one record.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.graph.replace import graph_replace
from pytensor.tensor.variable import TensorVariable

from ...compiler.codegen.arguments import LANES
from ...compiler.codegen.function_types import Graph
from ...compiler.codegen.scalarize import NotUnrollableError
from ...compiler.codegen.simd import LaneFunction, Places, lane_functions
from ...compiler.codegen.steps import step_functions
from ...compiler.lowering.constants import covariances
from ...compiler.lowering.symbols import call, uses
from ...compiler.native.entry_point import EntryPoint
from ...compiler.native.plan import Plan
from ...system.model import StateSpaceModel
from ..outcomes import Failure
from ..plan import make_plan
from ..protocol import System
from .machine import rows_of_vectors

MAX_EXPLICIT = 8  # states

ALONG = ("predict", "update", "along")
ALONG_BACK = ("predict_back", "update_back", "along_back")


@dataclass(frozen=True, eq=False)
class GaussianFilterFunctions:
    """A filter's functions for one system; the first ``system.n`` entries of s are the mean.

    * ``start``: theta -> s at step 0.
    * ``predict``: theta, u, t, s -> s of the next step.
    * ``update``: theta, u, t, d, s -> s, and the term log p(d_j | d_1 .. d_{j-1}).

    ``has_short_rows`` says whether a row of the Jacobian of a prediction takes few operations.
    """

    system: StateSpaceModel
    has_short_rows: bool
    start: Graph
    predict: Graph
    update: Graph

    @property
    def size(self) -> int:
        """Length of s."""
        return self.predict.inputs["s"].type.shape[0]


def vjps(recursion: GaussianFilterFunctions, *, explicit: bool) -> tuple[Graph, Graph, Graph]:
    """Vector-Jacobian products of start, predict and update.

    They take ``s_bar``, the cotangent of s, and ``c_bar``, that of theta, to which each adds; that
    of update takes ``term_bar`` too. They are linear in the cotangent, which is their only input
    from the later step.

    If ``explicit``, the row of the Jacobian for each of the first elements of the cotangent is
    computed explicitly: the processor does so ahead of time, and the cotangent then takes one
    multiplication. The other elements are propagated through the equations, with fewer operations
    in all. The numbers of explicit elements were chosen by measurement: with ten states rows no
    longer pay, and twenty would take 15 s to write out. A linearisation that evaluates the
    equations at many points has none, because each row is as long as a propagation; records side by
    side have none, because they fill the time in which a single one waits.
    """
    theta, s = (recursion.predict.inputs[name] for name in ("theta", "s"))
    s_bar, c_bar = s.type("s_bar"), theta.type("c_bar")
    term_bar = pt.tensor("term_bar", shape=(), dtype="float64")
    n, size = recursion.system.n, recursion.size
    of_predict, of_update = size if n == 1 else n, size + 1 if n <= 2 else 0
    if n > MAX_EXPLICIT:
        of_predict = 0
    if not explicit:
        of_predict = of_update = 0

    def vjp(part: Graph, wrt: list, cotangents: dict, n_explicit: int) -> Graph:
        values = list(cotangents.values())
        *states_bar, theta_bar = _pullback(part.outputs, values, wrt, n_explicit)
        inputs = {**part.inputs, **cotangents, "c_bar": c_bar}
        return Graph(inputs, [*states_bar, c_bar + theta_bar])

    state, state_and_term = {"s_bar": s_bar}, {"s_bar": s_bar, "term_bar": term_bar}
    return (
        vjp(recursion.start, [theta], state, 0),
        vjp(recursion.predict, [s, theta], state, of_predict),
        vjp(recursion.update, [s, theta], state_and_term, of_update),
    )


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


class Functions(NamedTuple):
    """Compiled functions by their slots in a plan, the rows of ``W``, and the number of lanes."""

    entries: Mapping[str, EntryPoint]
    n_rows: int
    n_lanes: int


def places_of(
    recursion: GaussianFilterFunctions, size: int, n_cov: int, n_noises: int = 0
) -> Places:
    """Where the functions of a filter with states of this size find vectors."""
    inputs, n = recursion.update.inputs, recursion.system.n
    n_theta, n_inputs, p = (inputs[name].type.shape[0] for name in ("theta", "u", "d"))
    rows = rows_of_vectors.py_func(n_theta, n_cov, p, size, n)
    names = rows._asdict() | {"term_bar": rows.term}
    return Places(names, rows.free, size, n_inputs, p, n_noises)


class Covariances(NamedTuple):
    """Covariances at theta, one behind the other; the place and size of each by its name."""

    values: TensorVariable
    places: Mapping[str, tuple[int, int]]


def covariances_at(
    system: StateSpaceModel, theta: TensorVariable, others: Sequence[str] = ()
) -> Covariances:
    """The covariances that depend on theta, and others by name."""
    found = {
        name: graph
        for name, graph in covariances(system).items()
        if name in others or uses(graph, ["theta"])
    }
    covs = [call(graph, system, {"theta": theta}) for graph in found.values()]
    sizes = [cov.type.shape[0] for cov in covs]
    firsts = np.cumsum([0, *(size**2 for size in sizes)]).tolist()
    values = pt.concatenate([np.zeros(0), *(cov.ravel() for cov in covs)])
    values = pt.specify_shape(values, (firsts[-1],))
    return Covariances(values, dict(zip(found, zip(firsts, sizes, strict=False), strict=True)))


def checked(system: StateSpaceModel, covs: Covariances, n_theta: int) -> tuple[int, ...]:
    """The settings of a plan: row in ``W``, size and failure of each covariance to check."""
    graphs = covariances(system)
    return tuple(
        number
        for name, (first, size) in covs.places.items()
        if uses(graphs[name], ["theta"])
        for number in (n_theta + first, size, Failure[name.upper()])
    )


@lru_cache(maxsize=256)
def forward_functions(recursion: GaussianFilterFunctions, *, in_lanes: bool) -> Functions:
    """The forward pass; raises NotUnrollableError where it cannot be written out for lanes."""
    start, predict, update = recursion.start, recursion.predict, recursion.update
    covs = covariances_at(recursion.system, start.inputs["theta"])
    start = Graph(start.inputs, [*start.outputs, covs.values])
    functions = {
        "start": LaneFunction(start, ["s", "cov"]),
        "predict": LaneFunction(predict, ["s"]),
        "update": LaneFunction(_where_it_succeeds(update) if in_lanes else update, ["s", "term"]),
    }
    places = places_of(recursion, recursion.size, covs.values.type.shape[0])
    return compiled(functions, places, ALONG, in_lanes=in_lanes)


@lru_cache(maxsize=256)
def backward_functions(recursion: GaussianFilterFunctions, *, in_lanes: bool) -> Functions:
    """The backward pass, whose rows are behind those of the forward pass."""
    explicit = recursion.has_short_rows and not in_lanes
    start, predict, update = vjps(recursion, explicit=explicit)
    functions = {
        "prepare_back": LaneFunction(Graph({"theta": predict.inputs["theta"]}, []), []),
        "predict_back": LaneFunction(predict, ["s_bar", "c_bar"], backwards=True),
        "update_back": LaneFunction(
            _where_seen(update) if in_lanes else update, ["s_bar", "c_bar"]
        ),
        "finish_back": LaneFunction(start, ["c_bar"]),
    }
    forward = forward_functions(recursion, in_lanes=in_lanes)
    covs = covariances_at(recursion.system, recursion.start.inputs["theta"])
    places = places_of(recursion, recursion.size, covs.values.type.shape[0])
    places = places._replace(n_rows=forward.n_rows)
    return compiled(functions, places, ALONG_BACK, in_lanes=in_lanes)


def compiled(
    functions: Mapping[str, LaneFunction],
    places: Places,
    along: tuple[str, str, str],
    *,
    in_lanes: bool,
) -> Functions:
    """The entry points of functions; see `step_functions` for those along a record."""
    if not in_lanes:
        return Functions(*step_functions(functions, places, along), 1)
    return Functions(*lane_functions(functions, places), LANES)


def filter_plan(
    system: System,
    recursion: GaussianFilterFunctions,
    runs: Sequence[EntryPoint],
    *,
    of_many: bool,
    leaves_tape: bool,
    goes_back: bool,
) -> Plan:
    """The plan of a pass along one record, or along many, in lanes if these fit.

    ``runs`` are the functions for records one after the other, and side by side.

    For a pass that leaves a tape or goes back along it, the functions of a gradient must fit too.
    """
    in_lanes = of_many and _fits_lanes(recursion, has_gradient=leaves_tape or goes_back)
    used = functions = forward_functions(recursion, in_lanes=in_lanes)
    entries = {**functions.entries, **extensions(system, goes_back=goes_back)}
    if goes_back:
        used = backward_functions(recursion, in_lanes=in_lanes)
        entries |= used.entries
    theta = recursion.start.inputs["theta"]
    covs = covariances_at(recursion.system, theta)
    return make_plan(
        system, runs[in_lanes], (), checked(recursion.system, covs, theta.type.shape[0]), **entries,
        state_size=recursion.size, n_lanes=used.n_lanes, n_rows=used.n_rows,
        n_covariances=covs.values.type.shape[0], leaves_tape=leaves_tape,
    )  # fmt: skip


def extensions(system: System, *, goes_back: bool = False) -> dict[str, EntryPoint]:
    """The functions from the user's parameters to those of the filter, if these are more."""
    back = system.extend_back if goes_back else None
    found = {"extend": system.extend, "extend_back": back}
    return {name: entry for name, entry in found.items() if entry is not None}


@lru_cache(maxsize=256)
def _fits_lanes(recursion: GaussianFilterFunctions, *, has_gradient: bool) -> bool:
    try:
        forward_functions(recursion, in_lanes=True)
        if has_gradient:
            backward_functions(recursion, in_lanes=True)
    except NotUnrollableError:
        return False
    return True


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
