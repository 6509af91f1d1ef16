"""A hybrid system: a regime of finitely many values beside continuous states moved by normal noise.

Given its regimes it is an ordinary system of the continuous states, see `given_regime`. What the
regimes do is a list of moves, see `finite_states`, whose probabilities are here.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache, reduce
from typing import NamedTuple

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.replace import graph_replace
from pytensor.tensor.variable import TensorVariable

from ...compiler.lowering.finite_states import FiniteStates, finite_states, start_symbols
from ...compiler.lowering.given_regime import given_regime
from ...compiler.lowering.structure import is_free_of, is_smooth_vector
from ...compiler.lowering.symbols import SYMBOLS, call, jacobian_of, symbols_of
from ...system.model import StateSpaceModel

Symbols = Mapping[str, TensorVariable]


class Drawn(NamedTuple):
    """Values of finite variables: the probability of each, and whether it has parameters."""

    probabilities: TensorVariable
    is_valid: TensorVariable

    @property
    def probability(self) -> TensorVariable:
        """That of all together; NaN if one has none, as of categories that do not sum to one."""
        is_valid = pt.all(self.is_valid > 0.0)
        each = [self.probabilities[i] for i in range(self.probabilities.type.shape[0] or 0)]
        # pt.prod has no second derivative
        return pt.switch(is_valid, reduce(pt.mul, each, pt.ones(())), np.nan)


class Step(NamedTuple):
    """A step in which the finite variables are given, and the next regime."""

    drawn: Drawn
    regime: TensorVariable


class Start(NamedTuple):
    """The same of a start, with mean and covariance of the continuous states."""

    drawn: Drawn
    regime: TensorVariable
    mean: TensorVariable
    cov: TensorVariable


@dataclass(frozen=True, eq=False)
class Hybrid:
    """A hybrid system and its finite states, which make up the regime.

    Columns of inputs of the ``given`` system are those of the system, the regime, and the values v
    of the finite variables of a step.
    """

    system: StateSpaceModel
    found: FiniteStates

    @cached_property
    def given(self) -> StateSpaceModel:
        """The system of the continuous states, given the others."""
        return given_regime(self.system, self.found)

    @property
    def n(self) -> int:
        """Number of continuous states."""
        return len(self.found.continuous)

    @property
    def regimes(self) -> np.ndarray:
        """The values (K, n_finite) of the regime."""
        return self.found.joint

    @cached_property
    def drawn(self) -> np.ndarray:
        """The joint values (M, n_v) that the finite variables of a step have in some regime."""
        return np.unique(self.found.step.values, axis=0)

    @cached_property
    def order(self) -> np.ndarray:
        """Where each state of the system is among the finite states, followed by the others."""
        return np.argsort([*self.found.indices, *self.found.continuous])

    def whole(self, regime: TensorVariable, x: TensorVariable) -> TensorVariable:
        """The state of the system, from the regime and the continuous states."""
        return pt.concatenate([regime, x])[self.order]

    def inputs(
        self, u: TensorVariable, regime: TensorVariable, v: TensorVariable | None = None
    ) -> TensorVariable:
        """A row of inputs of the ``given`` system; no observation reads v."""
        v = pt.zeros((self.drawn.shape[1],)) if v is None else v
        return pt.concatenate([u, regime, v])

    def step(
        self, values: Symbols, regime: TensorVariable, x: TensorVariable, v: TensorVariable
    ) -> Step:
        """A step from a regime and continuous states x."""
        graph, system = self.system.equations.finite_step, self.system
        if graph is None:
            return Step(_CERTAIN, regime)
        sizes = {name: symbol.type.shape for name, symbol in symbols_of(system).items()}
        state = {"x": self.whole(regime, x)}
        given = {name: values[name] for name in ("theta", "u", "t")} | state
        (found,) = graph.bind([given.get(name, pt.zeros(sizes[name])) for name in SYMBOLS] + [v])
        return Step(_law(found, system.n, v), found[list(self.found.indices)])

    def start(self, theta: TensorVariable, v: TensorVariable) -> Start:
        """The start in which the finite variables of ``initial_dist`` are v."""
        finite, others = list(self.found.indices), list(self.found.continuous)
        if self.system.equations.finite_start is None:
            mean = call(self.system.equations.initial_mean, self.system, {"theta": theta})
            cov = call(self.system.equations.initial_cov, self.system, {"theta": theta})
            return Start(_CERTAIN, mean[finite], mean[others], cov[others][:, others])
        symbols, found = start_symbols(self.system)
        z, n = symbols["z"], self.system.n
        gain = jacobian_of(found[:n][others], z)
        known = {z: pt.zeros(z.type.shape), symbols["theta"]: theta, symbols["v"]: v}
        outputs = [*_law(found, n, v), found[finite], found[others], gain @ gain.T]
        each, is_valid, *others = graph_replace(outputs, known, strict=False)
        return Start(Drawn(each, is_valid), *others)

    @cached_property
    def step_forgets_regime(self) -> bool:
        """Whether the continuous states move by what a step draws, not by the regime before it."""
        symbols = symbols_of(self.given)
        n_user, n_finite = self.system.n_input_columns, self.regimes.shape[1]
        regime = pt.tensor("regime", shape=(n_finite,), dtype="float64")
        u = symbols["u"]
        given = {**symbols, "u": pt.concatenate([u[:n_user], regime, u[n_user + n_finite :]])}
        step = call(self.given.equations.transition, self.given, given)
        return is_free_of(("regime",), step, {**symbols, "regime": regime})

    @cached_property
    def deciding(self) -> list[int]:
        """The continuous states on which the probabilities of the next regime depend."""
        names = [f"x{i}" for i in range(self.n)]
        sizes = {"regime": self.regimes.shape[1], "v": self.drawn.shape[1]} | dict.fromkeys(
            names, 1
        )
        parts = {i: pt.tensor(i, shape=(size,), dtype="float64") for i, size in sizes.items()}
        symbols = {**symbols_of(self.system), **parts}
        x = pt.concatenate([parts[name] for name in names])
        law = self.step(symbols, symbols["regime"], x, symbols["v"]).drawn.probabilities
        return [i for i, name in enumerate(names) if not is_free_of((name,), law, symbols)]

    @cached_property
    def is_smooth(self) -> bool:
        """Whether no equation has a kink or jump in states or parameters, given the regimes."""
        symbols, equations = symbols_of(self.given), self.given.equations
        u = symbols["u"][: self.system.n_input_columns]
        step, vectors = self.found.step, []
        for origin, v in zip(step.origin, step.values, strict=True):
            regime, drawn = pt.constant(self.regimes[origin]), pt.constant(v)
            given = {**symbols, "u": self.inputs(u, regime, drawn)}
            vectors.append(call(equations.transition, self.given, given))
            step_of = self.step(given | {"u": u}, regime, symbols["x"], drawn)
            vectors.append(step_of.drawn.probabilities)
            if equations.observation is not None:
                vectors.append(call(equations.observation, self.given, given))
        return is_smooth_vector(pt.concatenate(vectors), symbols)


@lru_cache(maxsize=64)
def hybrid_of(system: StateSpaceModel) -> Hybrid:
    """Divide a system into its regime and its continuous states."""
    return Hybrid(system, finite_states(system))


_CERTAIN = Drawn(pt.ones((1,)), pt.ones((1,)))


def _law(found: TensorVariable, n: int, v: TensorVariable) -> Drawn:
    """The law of the values v that follows n states, see `GivenValues`."""
    n_v = v.type.shape[0] or 0
    return Drawn(found[n : n + n_v], found[n + n_v : n + 2 * n_v])
