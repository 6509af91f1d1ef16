"""A system whose whole state is finite as tables of states and moves, and three functions.

* The probability of every start, of parameters.
* The probability of every move, of parameters, inputs and time.
* The log-density of an observation in every state.

Moves, and states, on which such a function does not differ are evaluated once: a regime with its
last four values has as many different probabilities as the regime alone. Each function has a second
one with its derivatives by the parameters on which it depends.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pytensor
import pytensor.scalar as ps
import pytensor.tensor as pt
from pytensor.graph.basic import Variable
from pytensor.graph.replace import graph_replace
from pytensor.tensor.variable import TensorVariable

from ...compiler.codegen.emitter import depends_on
from ...compiler.codegen.expressions import Expression, is_constant
from ...compiler.codegen.function_types import Graph
from ...compiler.codegen.functions import member_function, unrolled
from ...compiler.codegen.scalarize import NotUnrollableError
from ...compiler.lowering.finite_states import (
    Declared,
    FiniteStates,
    Moves,
    finite_states,
    sources_of,
    start_symbols,
    step_symbols,
)
from ...compiler.lowering.observation import observation_log_density
from ...compiler.lowering.structure import KINKED
from ...compiler.lowering.symbols import call, symbols_of
from ...compiler.native.entry_point import EntryPoint
from ...system.model import StateSpaceModel
from ..protocol import System
from .machine import sizes_and_tables

_ARGUMENTS = "c, inputs, k, t, Z, X, out"


@dataclass(frozen=True, eq=False)
class ChainFunctions:
    """The tables of a system, its functions by their slots in a plan, and their derivatives."""

    settings: tuple[float, ...]
    entries: Mapping[str, EntryPoint]
    derivatives: Mapping[str, EntryPoint]


@lru_cache(maxsize=64)
def chain_functions(system: System, declared: Declared) -> ChainFunctions:
    """The functions of a system whose states are all finite."""
    model, found = system.model, finite_states(system.model, declared)
    c = pt.tensor("c", shape=(system.n_constants,), dtype="float64")
    start = _Function("start", *_start(model), c, system.n_theta)
    move = _Function("move", *_move(model), c, system.n_theta)
    emission = _Function("emission", *_emission(model), c, system.n_theta)
    moves, table = _by_successor(found.step), table_of_states(found, model.n)
    of_move = move.distinct(table[moves.origin], moves.values)
    of_state = emission.distinct(table)
    settings = sizes_and_tables(
        table=table, origin=moves.origin, successor=moves.successor,
        move_states=table[moves.origin][of_move.first], move_values=moves.values[of_move.first],
        move_number=of_move.number, start_values=found.start.values,
        start_state=found.start.successor, emission_states=table[of_state.first],
        emission_number=of_state.number, start_rows=start.rows, move_rows=move.rows,
        emission_rows=emission.rows, is_invariant=not move.depends_on("u", "t"),
        one_by_one=emission.depends_on("u", "t"),
    )  # fmt: skip
    return ChainFunctions(
        settings,
        {"start": start.value(), "predict": move.value(), "update": emission.value()},
        {
            "finish_back": start.derivative(), "predict_back": move.derivative(),
            "update_back": emission.derivative(),
        },
    )  # fmt: skip


def _by_successor(moves: Moves) -> Moves:
    """The moves in the order of the states that they lead to."""
    order = np.argsort(moves.successor, kind="stable")
    return Moves(moves.origin[order], moves.values[order], moves.successor[order])


def table_of_states(found: FiniteStates, n: int) -> np.ndarray:
    """The states (K, n) of all joint values."""
    table = np.zeros((len(found.joint), n))
    table[:, list(found.indices)] = found.joint
    return table


def _start(model: StateSpaceModel) -> tuple[dict[str, TensorVariable], TensorVariable]:
    """The probability of a start, of theta and its values z."""
    symbols, output = start_symbols(model)
    x = pt.tensor("x", shape=(model.n,), dtype="float64")
    probability = _product(output[model.n :], symbols["v"].type.shape[0])
    return {"theta": symbols["theta"], "x": x, "z": symbols["v"]}, probability


def _move(model: StateSpaceModel) -> tuple[dict[str, TensorVariable], TensorVariable]:
    """The probability of a move, of theta, x, u, t and the values z."""
    symbols, output = step_symbols(model)
    probability = _product(output[model.n :], symbols["v"].type.shape[0])
    return {**{i: symbols[i] for i in ("theta", "x", "u", "t")}, "z": symbols["v"]}, probability


def _product(law: TensorVariable, n_v: int) -> TensorVariable:
    """The probability of all values; NaN where one of their distributions is none."""
    probability = pt.ones(())
    for i in range(n_v):
        probability = probability * pt.switch(law[n_v + i] > 0, law[i], np.nan)
    return probability


def _emission(model: StateSpaceModel) -> tuple[dict[str, TensorVariable], TensorVariable]:
    """log p(d | x), of theta, x, u, t and the observation z."""
    symbols = symbols_of(model)
    given = {i: symbols[i] for i in ("theta", *"xutd")}
    # Rows that are wholly missing are not evaluated.
    density = observation_log_density(model, given, is_complete=model.p == 1)
    return {**{i: symbols[i] for i in ("theta", *"xut")}, "z": symbols["d"]}, density


def is_smooth_in_parameters(model: StateSpaceModel) -> bool:
    """Whether probabilities and the observation have no kink or jump in theta; False if unknown.

    Distributions of observations count as smooth.
    """
    symbols, step = step_symbols(model)
    of_start, start = start_symbols(model)
    n_v, n_start = (given["v"].type.shape[0] for given in (symbols, of_start))
    graphs = [
        Graph(symbols, [step[model.n : model.n + n_v]]),
        Graph(of_start, [start[model.n : model.n + n_start]]),
    ]
    if model.equations.observation is not None:
        graphs.append(Graph(symbols, [call(model.equations.observation, model, symbols)]))
    try:
        values = [value for graph in graphs for value in unrolled(graph, to_ask=True)[0]]
    except NotUnrollableError:
        return False
    theta = frozenset(f"theta.{i}" for i in range(model.n_theta))
    dependent = depends_on(values, theta)
    return not any(_bends(e, dependent) for e in dependent)


def _bends(e: Expression, dependent: Collection[Expression]) -> bool:
    """Whether an operation has a kink or jump in arguments that are ``dependent``."""
    return isinstance(e.op, KINKED) and any(
        isinstance(a, Expression) and a in dependent
        for a in (e.args[:1] if isinstance(e.op, ps.Switch) else e.args)
    )


@dataclass(frozen=True)
class Distinct:
    """Where each different row of a table is first, and the number of each row among these."""

    first: np.ndarray
    number: np.ndarray


class _Function:
    """A number as a function of members x and z, and its derivatives by elements of theta."""

    def __init__(
        self,
        name: str,
        inputs: Mapping[str, TensorVariable],
        output: TensorVariable,
        c: TensorVariable,
        n_theta: int,
    ) -> None:
        self._name, self._inputs, self._c, self._n_theta = name, inputs, c, n_theta
        self._output = pt.atleast_1d(output)
        theta = inputs["theta"]
        self._gradient = pytensor.grad(
            output, theta, disconnected_inputs="ignore", return_disconnected="zero"
        )
        self._sources = self._find_sources()
        self.rows = self._find_rows()

    def _find_sources(self) -> set[str] | None:
        """The names of the inputs on which the value depends; None if that is not known."""
        try:
            (values,) = unrolled(Graph(self._inputs, [self._output]))
        except NotUnrollableError:
            return None
        return sources_of(values)

    def _find_rows(self) -> list[int]:
        """The elements of theta by which the derivative may not be zero."""
        try:
            (values,) = unrolled(Graph(self._inputs, [self._gradient]))
        except NotUnrollableError:
            return list(range(self._n_theta))
        return [i for i, value in enumerate(values) if not (is_constant(value) and value == 0)]

    def depends_on(self, *vectors: str) -> bool:
        """Whether the value may depend on one of these inputs."""
        return self._sources is None or any(s.split(".")[0] in vectors for s in self._sources)

    def distinct(self, X: np.ndarray, Z: np.ndarray | None = None) -> Distinct:
        """The different rows of the inputs x, and z unless it is an observation."""
        columns = [X[:, i] for i in range(X.shape[1]) if self._reads(f"x.{i}")]
        if Z is not None:
            columns += [Z[:, i] for i in range(Z.shape[1]) if self._reads(f"z.{i}")]
        if not columns:
            columns = [np.zeros(len(X))]
        table = np.stack(columns, axis=-1)
        _, first, number = np.unique(table, axis=0, return_index=True, return_inverse=True)
        return Distinct(first, number.ravel())

    def _reads(self, element: str) -> bool:
        return self._sources is None or element in self._sources

    def value(self) -> EntryPoint:
        """The entry point of the value."""
        return self._entry(self._name, self._output)

    def derivative(self) -> EntryPoint:
        """The entry point of the derivatives, one row for each of ``rows``."""
        return self._entry(f"{self._name}_derivative", self._gradient[self.rows or [0]])

    def _entry(self, name: str, output: TensorVariable) -> EntryPoint:
        whole = self._c[: self._n_theta]
        (at_c,) = graph_replace([output], {self._inputs["theta"]: whole}, strict=False)
        inputs: dict[str, Variable] = {**self._inputs, "theta": self._c}
        return member_function(name, _ARGUMENTS, Graph(inputs, [at_c]), "out").entry
