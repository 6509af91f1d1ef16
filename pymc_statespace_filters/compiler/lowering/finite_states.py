"""States that take finitely many values: which they are, their values, and what leads to which.

A state is finite if its start is a number or a finite variable of ``initial_dist``, and its next
value a function of finite states and of finite variables of ``process_dist`` alone: a regime, its
memories, bounded counts. What happens in a step is a list of `Moves`, one for each value of these
variables at each joint value of these states, if it is possible at some parameters. The list is
found by going from the values at the start to those after one step, and so on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.tensor.variable import TensorVariable

from ...errors import ModelError
from ...system.distributions.finite import MAX_TRIALS
from ...system.model import StateSpaceModel
from ..codegen.expressions import Value, in_order
from ..codegen.function_types import Graph
from ..codegen.functions import unrolled
from ..codegen.scalarize import NotUnrollableError
from .known_values import Known, known_values
from .symbols import SYMBOLS, call, symbols_of

MAX_JOINT = 4096
"""Joint values of all finite states."""
MAX_MOVES = 2**19
MAX_VALUES = 1024  # of one state


@dataclass(frozen=True, eq=False)
class Moves:
    """What may happen from ``origin`` (M,), a row of the joint values, to ``successor`` (M,).

    ``values`` (M, n_v) are those of the finite variables. Of a start, all origins are 0.
    """

    origin: np.ndarray
    values: np.ndarray
    successor: np.ndarray


@dataclass(frozen=True, eq=False)
class FiniteStates:
    """The finite states of a system.

    ``joint`` (K, len(indices)) are the joint values that the system may reach, in lexicographic
    order. ``unbounded`` are the finite variables of ``process_dist`` whose values depend on other
    things than finite states, such as a binomial one whose number of trials is a parameter;
    ``values`` of moves are NaN there.
    """

    indices: tuple[int, ...]  # which states of the system are finite
    continuous: tuple[int, ...]  # the others
    why_not: Mapping[str, str]  # why each of the others is none of them, by its name
    joint: np.ndarray
    start: Moves  # the possible values at step 0
    step: Moves  # what a step may do
    unbounded: tuple[int, ...]


class TooManyValuesError(Exception):
    """More values than can be enumerated."""

    def __init__(self, what: str, found: int, counts: Sequence[int]) -> None:
        super().__init__(what)
        self.what, self.found, self.counts = what, found, counts


type Declared = tuple[tuple[str, tuple[float, ...]], ...]


@lru_cache(maxsize=256)
def finite_states(model: StateSpaceModel, declared: Declared = ()) -> FiniteStates:
    """The finite states of a system.

    ``declared`` are values of states by name: these are reached even if the start does not lead
    there, and no others are. Raises `ModelError` if there are too many joint values, or a state has
    values that were not declared.
    """
    search = _Search(model, {model.states.index(name): values for name, values in declared})
    while (found := search.attempt()) is None:
        pass
    return found


class _Search:
    """The states that may still be finite, and why others are not."""

    def __init__(self, model: StateSpaceModel, declared: Mapping[int, tuple[float, ...]]) -> None:
        self.model, self.declared = model, declared
        self.why_not: dict[int, str] = {}
        self.step, self.start = step_given_values(model), start_given_values(model)

    def candidates(self) -> list[int]:
        return [i for i in range(self.model.n) if i not in self.why_not]

    def exclude(self, i: int, why: str) -> None:
        self.why_not.setdefault(i, why)

    def attempt(self) -> FiniteStates | None:
        """The finite states among the candidates; None if a candidate turned out to be none."""
        n_before = len(self.why_not)
        self._check_sources()
        if len(self.why_not) > n_before:
            return None
        states = self.candidates()
        try:
            found = self._reach(states)
        except _NotFiniteError as error:
            self.exclude(error.state, error.why)
            return None
        except TooManyValuesError as error:
            if max(error.counts, default=0) <= MAX_VALUES:
                raise ModelError(
                    f"the finite states {[self.model.states[i] for i in states]} have more than "
                    f"{error.found} {error.what}, which are too many to enumerate"
                ) from None
            worst = states[int(np.argmax(error.counts))]
            self.exclude(worst, f"takes more than {MAX_VALUES} values")
            return None
        return found

    def _check_sources(self) -> None:
        """Exclude the states that depend on something that is not finite."""
        names = self.model.states
        for i in self.candidates():
            for source in sorted(self.step.sources(i)):
                vector, _, number = source.partition(".")
                if vector == "q":
                    self.exclude(i, "moves by a variable that takes infinitely many values")
                elif vector == "x" and int(number) in self.why_not:
                    self.exclude(i, f"depends on the state {names[int(number)]}")
            if i not in self.declared and any(s[0] == "z" for s in self.start.sources(i)):
                self.exclude(i, "starts from a distribution with infinitely many values")

    def _reach(self, states: list[int]) -> FiniteStates:
        """Go from the values at the start to all others."""
        start = self.start.enumerate(states, np.zeros((1, 0)), [])
        first = start.next_values(self.model, "at the start")
        joint = np.unique(np.concatenate([first, self._declared_joint(states, first)]), axis=0)
        found, frontier = {tuple(row) for row in joint}, joint
        while len(frontier):
            moved = self.step.enumerate(states, frontier, states).next_values(self.model, "")
            self._check_declared(states, moved)
            new = {tuple(row) for row in moved} - found
            found |= new
            if len(found) > MAX_JOINT:
                counts = [len({row[i] for row in found}) for i in range(len(states))]
                raise TooManyValuesError("joint values", MAX_JOINT, counts)
            frontier = np.array(sorted(new)).reshape(len(new), len(states))
        joint = np.array(sorted(found)).reshape(len(found), len(states))
        step = self.step.enumerate(states, joint, states)
        names = self.model.states
        return FiniteStates(
            tuple(states),
            tuple(sorted(self.why_not)),
            {names[i]: why for i, why in sorted(self.why_not.items())},
            joint,
            start.moves(joint, self.model),
            step.moves(joint, self.model),
            tuple(step.unbounded),
        )

    def _declared_joint(self, states: Sequence[int], first: np.ndarray) -> np.ndarray:
        """All combinations of declared values and the values of the others at the start."""
        if not self.declared:
            return first
        columns = [
            np.asarray(self.declared.get(i, np.unique(first[:, k])), dtype="float64")
            for k, i in enumerate(states)
        ]
        if np.prod([len(c) for c in columns], dtype=float) > MAX_JOINT:
            raise TooManyValuesError("joint values", MAX_JOINT, [])
        return np.stack([g.ravel() for g in np.meshgrid(*columns, indexing="ij")], axis=-1)

    def _check_declared(self, states: Sequence[int], moved: np.ndarray) -> None:
        for k, i in enumerate(states):
            if i not in self.declared:
                continue
            others = sorted(set(moved[:, k].tolist()) - set(self.declared[i]))
            if others:
                raise ModelError(
                    f"values: {self.model.states[i]!r} must stay within "
                    f"{list(self.declared[i])}, and a step may lead to {others[0]:g}"
                )


class _NotFiniteError(Exception):
    def __init__(self, state: int, why: str) -> None:
        super().__init__(why)
        self.state, self.why = state, why


class Given:
    """A step, or the start, given the values of finite variables, written out in scalars.

    The next value of each state, and of each variable the probability, whether its parameters are
    valid, and its smallest and largest value. ``known`` are the elements of x that a caller gives.
    """

    def __init__(
        self, symbols: Mapping[str, TensorVariable], output: TensorVariable, n: int
    ) -> None:
        self.n, self.n_v = n, symbols["v"].type.shape[0] or 0
        try:
            (values,) = unrolled(Graph(symbols, [output]), to_ask=True)
        except NotUnrollableError as reason:
            values, self.reason = [], str(reason)
        self.values: list[Value] = values
        rest = values[n:]
        parts = [rest[i * self.n_v : (i + 1) * self.n_v] for i in range(4)]
        self.probability, self.valid, self.lower, self.upper = parts
        self._sources: dict[int, set[str]] = {}

    def sources(self, i: int) -> set[str]:
        """The names of the inputs on which the next value of a state depends."""
        if not self.values:
            return {"q.0"}
        if i not in self._sources:
            self._sources[i] = sources_of([self.values[i]])
        return self._sources[i]

    def enumerate(
        self, states: Sequence[int], joint: np.ndarray, known: Sequence[int]
    ) -> "_Enumeration":
        """All combinations of values of the variables that are possible at each joint value."""
        rows = _Enumeration(self, states, np.arange(len(joint)), {})
        rows.given = {f"x.{i}": joint[:, k] for k, i in enumerate(known)}
        for k in range(len(self.lower)):  # none is known of a step that is not written out
            rows.branch(k)
        return rows


def sources_of(values: Sequence[Value]) -> set[str]:
    """The names of the inputs on which values depend."""
    return {str(e.args[0]) for e in in_order(values, {}) if e.op is None}


class _Enumeration:
    """Rows of values of variables, one after the other: ``given`` holds a column for each."""

    def __init__(
        self,
        given_by: Given,
        states: Sequence[int],
        origin: np.ndarray,
        given: dict[str, np.ndarray],
    ) -> None:
        self.by, self.states, self.origin, self.given = given_by, states, origin, given
        self.unbounded: list[int] = []

    def look_up(self, values: Sequence[Value]) -> list[Known]:
        """What is known of some values in every row."""
        return known_values(values, self.given, self.origin.size)

    def branch(self, k: int) -> None:
        """Repeat every row for each value of a variable, without those of probability zero."""
        lower, upper = self.look_up([self.by.lower[k], self.by.upper[k]])
        if not (lower.everywhere and upper.everywhere) or (upper.value > MAX_TRIALS).any():
            self.unbounded.append(k)  # no column: what depends on it is not known
            return
        counts = np.maximum(upper.value - lower.value + 1, 0).astype(int)
        if counts.sum() > MAX_MOVES:
            raise TooManyValuesError("moves", MAX_MOVES, [])
        repeated = np.repeat(np.arange(self.origin.size), counts)
        within = np.arange(repeated.size) - np.repeat(np.cumsum(counts) - counts, counts)
        self._take(repeated)
        self.given[f"v.{k}"] = lower.value[repeated] + within
        (probability,) = self.look_up([self.by.probability[k]])
        self._take(~(probability.is_known & (probability.value == 0)))

    def _take(self, rows: np.ndarray) -> None:
        self.origin = self.origin[rows]
        self.given = {name: column[rows] for name, column in self.given.items()}

    def next_values(self, model: StateSpaceModel, when: str) -> np.ndarray:
        """The values of the states after each row."""
        found = self.look_up([self.by.values[i] for i in self.states])
        for i, known in zip(self.states, found, strict=True):
            if not known.everywhere:
                raise _NotFiniteError(i, self._why(i, when))
            if not np.isfinite(known.value).all():
                raise _NotFiniteError(
                    i, f"takes the value {known.value[~np.isfinite(known.value)][0]}"
                )
        columns = [np.asarray(known.value, dtype="float64") for known in found]
        return np.stack(columns, axis=-1) if columns else np.zeros((self.origin.size, 0))

    def _why(self, i: int, when: str) -> str:
        sources = self.by.sources(i)
        if any(f"v.{k}" in sources for k in self.unbounded):
            return "is moved by a variable whose number of trials is not a number"
        what = "starts from a value that depends" if when else "moves by an amount that depends"
        return (
            f"{what} on parameters, inputs or time; draw it by pm.Bernoulli or pm.Categorical, "
            "whose probabilities may depend on them"
        )

    def moves(self, joint: np.ndarray, model: StateSpaceModel) -> Moves:
        """The rows as moves between these joint values."""
        places = {tuple(row): i for i, row in enumerate(joint)}
        successor = [places[tuple(row)] for row in self.next_values(model, "")]
        columns = [
            self.given.get(f"v.{k}", np.full(self.origin.size, np.nan)) for k in range(self.by.n_v)
        ]
        values = np.stack(columns, axis=-1) if columns else np.zeros((self.origin.size, 0))
        return Moves(self.origin, values, np.array(successor, dtype=np.int64))


def step_given_values(model: StateSpaceModel) -> Given:
    """A step given the values of the finite variables in ``process_dist``."""
    symbols, output = step_symbols(model)
    return Given(symbols, output, model.n)


def step_symbols(
    model: StateSpaceModel,
) -> tuple[dict[str, TensorVariable], TensorVariable]:
    """Symbols, with the values ``v``, and the step with its law as a function of them."""
    symbols, graph = symbols_of(model), model.equations.finite_step
    n_v = 0 if graph is None else graph.inputs[-1].type.shape[0]
    symbols["v"] = pt.tensor("v", shape=(n_v,), dtype="float64")
    if graph is None:
        return symbols, call(model.equations.transition, model, symbols)
    (output,) = graph.bind([*(symbols[name] for name in SYMBOLS), symbols["v"]])
    return symbols, output


def start_given_values(model: StateSpaceModel) -> Given:
    """The state at step 0 given the values of the finite variables in ``initial_dist``."""
    symbols, output = start_symbols(model)
    return Given(symbols, output, model.n)


def start_symbols(
    model: StateSpaceModel,
) -> tuple[dict[str, TensorVariable], TensorVariable]:
    """Symbols of the start: parameters, normals ``z``, values ``v``; and the start with its law."""
    graph: FrozenFunctionGraph | None = model.equations.finite_start
    theta = symbols_of(model)["theta"]
    if graph is not None:
        z, v = graph.inputs[1].type("z"), graph.inputs[2].type("v")
        (output,) = graph.bind([theta, z, v])
        return {"theta": theta, "z": z, "v": v}, output
    none = pt.tensor("v", shape=(0,), dtype="float64")
    draw: Any = model.equations.initial_draw
    if draw is not None:
        z = draw.inputs[1].type("z")
        (output,) = draw.bind([theta, z])
        return {"theta": theta, "z": z, "v": none}, output
    z = pt.tensor("z", shape=(model.n,), dtype="float64")
    mean = call(model.equations.initial_mean, model, {"theta": theta})
    cov = call(model.equations.initial_cov, model, {"theta": theta})
    # Which states vary, not how: products with variances of zero vanish.
    return {"theta": theta, "z": z, "v": none}, mean + pt.diagonal(cov) * z
