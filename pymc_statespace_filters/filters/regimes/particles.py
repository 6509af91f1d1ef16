"""A hybrid system as a Rao-Blackwellised particle filter sees it: as that of its particles.

A particle is one vector: a regime, then mean and covariance of the continuous states given all its
regimes so far. One normal decides what the finite variables of a step are: the first of their
joint values at which the cumulated probability exceeds that of the normal.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.graph.replace import graph_replace
from pytensor.tensor.variable import TensorVariable

from ...compiler.codegen.function_types import Graph, MemberFunction
from ...compiler.codegen.functions import member_function
from ...compiler.lowering.compiled_system import CompiledSystem, compile_system
from ...compiler.lowering.symbols import SYMBOLS, symbols_of
from ...system.model import StateSpaceModel
from ...system.quantiles import normal_probability
from ...system.tracing import Equations
from ..gaussian.linearization import (
    Linearization,
    linearizations_of,
    pack,
    predict,
    state_size,
    update,
)
from .draws import draws_of, total_of
from .hybrid import Hybrid, Symbols, hybrid_of


@dataclass(frozen=True, eq=False)
class HybridParticles:
    """The system of the particles, and what an observation does to them."""

    hybrid: Hybrid
    system: CompiledSystem  # its state is a particle, its noise one normal
    linearization: Linearization

    @cached_property
    def condition(self) -> MemberFunction:
        """Condition every particle on an observation; log p(d) of each goes to a row below it."""
        equations = ParticleEquations(self.hybrid, self.linearization)
        regime, state = equations.parts(equations.particle)
        state, term = equations.updated(equations.values, regime, state)
        outputs = pt.concatenate([regime, state, [term]])
        return self._function("condition", "c, inputs, k, t, d, X", equations, outputs, "utd", {})

    @cached_property
    def move_to_observation(self) -> MemberFunction:
        """Move every particle one step by a regime drawn given the observation behind it.

        The log of the density of the observation given the particle before goes to a row below it.
        ``gains`` are the observation, the inputs at its step, and its time.
        """
        equations = ParticleEquations(self.hybrid, self.linearization)
        p, n_inputs = self.hybrid.system.p, self.hybrid.system.n_input_columns
        seen = pt.tensor("gains", shape=(p + n_inputs + 1,), dtype="float64")
        later = {"d": seen[:p], "u": seen[p : p + n_inputs], "t": seen[p + n_inputs]}
        outputs = equations.moved_to_observation({**equations.values, **later})
        others = {"z": equations.z, "gains": seen}
        arguments = "c, inputs, k, t, gains, Z, X"
        return self._function("move_to_observation", arguments, equations, outputs, "ut", others)

    def _function(self, name, arguments, equations, outputs, inputs, others) -> MemberFunction:
        """The function of particles that are followed by a number in memory."""
        n = self.system.n
        longer, c = pt.tensor("x", shape=(n + 1,), dtype="float64"), self.system.constants
        known = {
            equations.particle: longer[:n],
            equations.values["theta"]: c[: self.system.n_theta],
        }
        (outputs,) = graph_replace([outputs], known, strict=False)
        given = {name: equations.values[name] for name in inputs}
        graph = Graph({"theta": c, "x": longer, **given, **others}, [outputs])
        return member_function(name, arguments, graph, "X")


@lru_cache(maxsize=64)
def hybrid_particles(system: StateSpaceModel, linearization: Linearization) -> HybridParticles:
    """The particles of a hybrid system whose Kalman filters have this linearisation."""
    hybrid = hybrid_of(system)
    model = ParticleEquations(hybrid, linearization).system()
    return HybridParticles(hybrid, compile_system(model), linearization)


class ParticleEquations:
    """Steps and updates of one particle, as graphs."""

    def __init__(self, hybrid: Hybrid, linearization: Linearization) -> None:
        self.hybrid = hybrid
        self.n_finite = hybrid.regimes.shape[1]
        self.n = self.n_finite + state_size(hybrid.n)
        self.values = symbols_of(hybrid.system)
        self.particle = pt.tensor("x", shape=(self.n,), dtype="float64")
        self.z = pt.tensor("z", shape=(1,), dtype="float64")
        given = symbols_of(hybrid.given)
        given["s"] = pt.tensor("s", shape=(state_size(hybrid.n),), dtype="float64")
        by = linearizations_of(hybrid.given, linearization)
        self.given, self.linearizations = given, by
        self._predicted = predict(by.transition, hybrid.given, given)
        self._updated = update(by.observation, hybrid.given, given)

    def parts(self, particle: TensorVariable) -> tuple[TensorVariable, TensorVariable]:
        """Regime, and mean and covariance."""
        return particle[: self.n_finite], particle[self.n_finite :]

    def predicted(
        self, values: Symbols, regime: TensorVariable, state: TensorVariable, v: TensorVariable
    ) -> TensorVariable:
        """Mean and covariance after a step."""
        return graph_replace(self._predicted, self.known(values, regime, state, v), strict=False)

    def updated(
        self, values: Symbols, regime: TensorVariable, state: TensorVariable
    ) -> tuple[TensorVariable, TensorVariable]:
        """Mean and covariance given an observation, and its log-density."""
        known = self.known(values, regime, state)
        return tuple(graph_replace(list(self._updated), known, strict=False))

    def known(
        self,
        values: Symbols,
        regime: TensorVariable,
        state: TensorVariable,
        v: TensorVariable | None = None,
    ) -> dict[TensorVariable, TensorVariable]:
        """What the symbols of the system of the continuous states are replaced by."""
        named = {**values, "s": state, "u": self.hybrid.inputs(values["u"], regime, v)}
        return {self.given[name]: named[name] for name in ("theta", "u", "t", "d", "s")}

    def step(self) -> TensorVariable:
        """The particle after a step."""
        regime, state = self.parts(self.particle)
        drawn = [pt.constant(v) for v in self.hybrid.drawn]
        parts = draws_of(self.hybrid, self.values, regime, state, drawn)
        both = [pt.concatenate([v, part.state]) for v, part in zip(drawn, parts, strict=True)]
        chosen = self._chosen([part.weight for part in parts], both)
        v, state = chosen[: drawn[0].type.shape[0]], chosen[drawn[0].type.shape[0] :]
        moved = self.predicted(self.values, regime, state, v)
        return pt.concatenate([self.next_regime(regime, state, v), moved])

    def next_regime(
        self, regime: TensorVariable, state: TensorVariable, v: TensorVariable
    ) -> TensorVariable:
        """The regime to which values of the finite variables lead."""
        return self.hybrid.step(self.values, regime, state[: self.hybrid.n], v).regime

    def moved_to_observation(self, later: Symbols) -> TensorVariable:
        """The particle after a step and an observation, and the log-density of the latter.

        Every value of the finite variables is tried.
        """
        regime, state = self.parts(self.particle)
        weights, terms, particles = [], [], []
        drawn = [pt.constant(v) for v in self.hybrid.drawn]
        parts = draws_of(self.hybrid, self.values, regime, state, drawn)
        for v, (weight, given) in zip(drawn, parts, strict=True):
            regime_after = self.next_regime(regime, given, v)
            forecast = self.predicted(self.values, regime, given, v)
            analysis, term = self.updated(later, regime_after, forecast)
            weights.append(weight)
            terms.append(pt.switch(pt.eq(weight, 0.0), -np.inf, term))
            particles.append(pt.concatenate([regime_after, analysis]))
        largest = pt.max(pt.stack(terms))
        joint = [
            pt.switch(pt.eq(w, 0.0), 0.0, w * pt.exp(term - largest))
            for w, term in zip(weights, terms, strict=True)
        ]
        log_density = largest + pt.log(total_of(joint))
        return pt.concatenate([self._chosen(joint, particles), [log_density]])

    def start(self) -> TensorVariable:
        """A particle at step 0."""
        starts = self.hybrid.found.start
        found = [self.hybrid.start(self.values["theta"], pt.constant(v)) for v in starts.values]
        particles = [pt.concatenate([s.regime, pack(s.mean, s.cov)]) for s in found]
        return self._chosen([start.drawn.probability for start in found], particles)

    def _chosen(
        self, weights: Sequence[TensorVariable], vectors: Sequence[TensorVariable]
    ) -> TensorVariable:
        """The vector on whose share of the weights the normal falls; NaN where a weight is."""
        total, below, chosen = total_of(weights), weights[0], vectors[0]
        place = normal_probability(self.z[0]) * total
        for i, vector in enumerate(vectors[1:], start=1):
            chosen = pt.switch(place >= below, vector, chosen)
            below = below + weights[i]
        return pt.switch(pt.isnan(total), np.nan, chosen)

    def system(self) -> StateSpaceModel:
        """A system whose state is a particle."""
        model, n = self.hybrid.system, self.n
        no_noise = pt.tensor("e", shape=(0,), dtype="float64")
        symbols = {**self.values, "x": self.particle, "q": self.z, "e": no_noise}
        _, term = self.updated(self.values, *self.parts(self.particle))
        inputs = [symbols[name] for name in SYMBOLS]

        def frozen(output: TensorVariable) -> FrozenFunctionGraph:
            return FrozenFunctionGraph.from_io(inputs, [output])

        columns = tuple(f"column {i}" for i in range(model.n_input_columns))
        start = FrozenFunctionGraph.from_io([self.values["theta"], self.z], [self.start()])
        equations = Equations(
            transition=frozen(self.step()),
            gaussian_transition=None,
            process_noise=None,
            observation=None,
            observation_noise=None,
            observation_draw=None,
            observation_logp=frozen(pt.atleast_1d(term)),
            initial_mean=frozen(pt.zeros((n,))),
            initial_cov=frozen(pt.zeros((n, n))),
            initial_draw=start,
        )
        return model._with(
            n=n, m=1, r=0, states=tuple(f"particle {i}" for i in range(n)), inputs=columns,
            n_inputs=len(columns), carried=(), accumulators=(), drifting=(), discrete_noise=False,
            gaussian_observation=False, keeps_noises=True, equations=equations,
        )  # fmt: skip
