"""The interacting multiple model filter: a Gaussian for each regime, merged after every step.

Blom and Bar-Shalom (1988), "The interacting multiple model algorithm for systems with Markovian
switching coefficients", IEEE Transactions on Automatic Control 33, 780-783. They mix the Gaussians
before a step, which depends on the regime that it leads to. A step that depends on the regime
before it as well is made from every regime, and what arrives in one is merged then.

The vector ``s`` of the filter is mean and covariance of the whole state, which only results read;
then the probability of each regime; then mean and covariance of the continuous states given each.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
import pytensor.tensor as pt
from pytensor.gradient import disconnected_grad
from pytensor.graph.replace import graph_replace
from pytensor.tensor.variable import TensorVariable

from ...compiler.codegen.function_types import Graph
from ...compiler.lowering.symbols import symbols_of
from ...system.model import StateSpaceModel
from ..gaussian.functions import GaussianFilterFunctions
from ..gaussian.linearization import (
    Linearization,
    linearizations_of,
    pack,
    predict,
    state_size,
    unpack,
    update,
)
from .draws import Weighted, draws_of, total_of
from .hybrid import Hybrid, hybrid_of


def merged(parts: Sequence[Weighted], n: int) -> Weighted:
    """The normal distribution with mean and covariance of a mixture, and the whole weight.

    Where all weights are zero the parts count alike: an impossible regime has some state, too.
    """
    if len(parts) == 1:
        return parts[0]
    total = total_of([part.weight for part in parts])
    is_possible = pt.neq(total, 0.0)
    divisor = pt.switch(is_possible, total, 1.0)
    shares = [pt.switch(is_possible, part.weight / divisor, 1 / len(parts)) for part in parts]
    moments = [unpack(part.state, n) for part in parts]
    mean = pt.add(*(w * m for w, (m, _) in zip(shares, moments, strict=True)))
    covs = [
        w * (cov + (m - mean)[:, None] * (m - mean)[None, :])
        for w, (m, cov) in zip(shares, moments, strict=True)
    ]
    return Weighted(total, pack(mean, pt.add(*covs)))


@lru_cache(maxsize=64)
def mixture_functions(
    system: StateSpaceModel, linearization: Linearization
) -> GaussianFilterFunctions:
    """The three functions of the filter for a hybrid system."""
    return _Mixture(hybrid_of(system), linearization).functions()


class _Mixture:
    """The recursion, written out for all regimes."""

    def __init__(self, hybrid: Hybrid, linearization: Linearization) -> None:
        self.hybrid = hybrid
        self.size_of_one = state_size(hybrid.n)
        self.size = state_size(hybrid.system.n) + len(hybrid.regimes) * (1 + self.size_of_one)
        self.values = symbols_of(hybrid.system)
        self.values["s"] = pt.tensor("s", shape=(self.size,), dtype="float64")
        by, given = linearizations_of(hybrid.given, linearization), symbols_of(hybrid.given)
        given |= {name: self.values[name] for name in ("theta", "t", "d")}
        given["s"] = pt.tensor("s", shape=(self.size_of_one,), dtype="float64")
        self._given = given
        self._predicted = predict(by.transition, hybrid.given, given)
        self._updated = update(by.observation, hybrid.given, given)

    def functions(self) -> GaussianFilterFunctions:
        """Start, prediction and update of the vector ``s``."""

        def function(inputs: str, *outputs: TensorVariable) -> Graph:
            return Graph({name: self.values[name] for name in inputs.split()}, outputs)

        before = self._regimes(self.values["s"])
        analysis, term = self._update(before)
        return GaussianFilterFunctions(
            self.hybrid.system,
            False,  # explicit rows would be those of the moments that nothing reads
            function("theta", self._pack(self._start())),
            function("theta u t s", self._pack(self._predict(before))),
            function("theta u t d s", self._pack(analysis), pt.atleast_1d(term)),
        )

    def _regimes(self, s: TensorVariable) -> list[Weighted]:
        """Probability and state of each regime."""
        first, count, size = (
            state_size(self.hybrid.system.n),
            len(self.hybrid.regimes),
            self.size_of_one,
        )
        states = s[first + count :]
        return [Weighted(s[first + r], states[r * size : (r + 1) * size]) for r in range(count)]

    def _pack(self, parts: Sequence[Weighted]) -> TensorVariable:
        weights = pt.stack([part.weight for part in parts])
        return pt.concatenate([self._moments(parts), weights, *(part.state for part in parts)])

    def _moments(self, parts: Sequence[Weighted]) -> TensorVariable:
        """Mean and covariance of the whole state, of which the regime is known given itself."""
        hybrid, n_finite = self.hybrid, self.hybrid.regimes.shape[1]
        n, order, whole = hybrid.system.n, hybrid.order, []
        for regime, part in zip(hybrid.regimes, parts, strict=True):
            mean, cov = unpack(part.state, hybrid.n)
            padded = pt.zeros((n, n))[n_finite:, n_finite:].set(cov)[order][:, order]
            whole.append(
                Weighted(part.weight, pack(hybrid.whole(pt.constant(regime), mean), padded))
            )
        return merged(whole, n).state

    def _start(self) -> list[Weighted]:
        starts, found = self.hybrid.found.start, defaultdict(list)
        for v, regime in zip(starts.values, starts.successor, strict=True):
            start = self.hybrid.start(self.values["theta"], pt.constant(v))
            found[regime].append(Weighted(start.drawn.probability, pack(start.mean, start.cov)))
        return self._collected(found)

    def _predict(self, before: Sequence[Weighted]) -> list[Weighted]:
        """One step of every regime, by every way that there is."""
        found, leaving = defaultdict(list), self._leaving(before)
        for (*v, regime), moves in self._ways().items():
            parts = [leaving[move] for move in moves]
            origins = [int(self.hybrid.found.step.origin[move]) for move in moves]
            if self.hybrid.step_forgets_regime:
                parts, origins = [merged(parts, self.hybrid.n)], origins[:1]
            for part, origin in zip(parts, origins, strict=True):
                found[int(regime)].append(self._moved(part, origin, pt.constant(np.array(v))))
        return self._collected(found)

    def _ways(self) -> Mapping[tuple[float, ...], list[int]]:
        """The moves with the same values of the finite variables, to the same regime."""
        step, ways = self.hybrid.found.step, defaultdict(list)
        for move, (v, regime) in enumerate(zip(step.values, step.successor, strict=True)):
            ways[*v, regime].append(move)
        return ways

    def _leaving(self, before: Sequence[Weighted]) -> dict[int, Weighted]:
        """What of its regime takes each of the moves."""
        step, found = self.hybrid.found.step, {}
        for origin, part in enumerate(before):
            moves = np.flatnonzero(step.origin == origin)
            regime, drawn = (
                self.hybrid.regimes[origin],
                [pt.constant(v) for v in step.values[moves]],
            )
            parts = draws_of(self.hybrid, self.values, pt.constant(regime), part.state, drawn)
            for move, (weight, state) in zip(moves.tolist(), parts, strict=True):
                found[move] = Weighted(part.weight * weight, state)
        return found

    def _moved(self, part: Weighted, origin: int, v: TensorVariable) -> Weighted:
        state = graph_replace(self._predicted, self._known(part.state, origin, v), strict=False)
        return Weighted(part.weight, state)

    def _known(self, state: TensorVariable, regime: int, v: TensorVariable | None = None):
        """State and inputs of the given system."""
        row = self.hybrid.inputs(self.values["u"], pt.constant(self.hybrid.regimes[regime]), v)
        return {self._given["s"]: state, self._given["u"]: row}

    def _collected(self, found: Mapping[int, Sequence[Weighted]]) -> list[Weighted]:
        """Merge what arrives in each regime; where nothing does, the state is that of another."""
        some = next(iter(found.values()))[0]
        nothing = [Weighted(pt.zeros(()), some.state)]
        return [
            merged(found.get(r, nothing), self.hybrid.n) for r in range(len(self.hybrid.regimes))
        ]

    def _update(self, before: Sequence[Weighted]) -> tuple[list[Weighted], TensorVariable]:
        """Every regime by the observation, and the log of the mean of its densities."""
        analyses, terms = [], []
        for r, part in enumerate(before):
            known = self._known(part.state, r)
            analysis, term = graph_replace(list(self._updated), known, strict=False)
            analyses.append(analysis)
            terms.append(pt.switch(pt.isnan(term) & pt.eq(part.weight, 0.0), -np.inf, term))
        # A weight of zero has a derivative, too: its density must be finite, but need not be right
        # where it is far above that of what is possible.
        possible = [
            pt.switch(pt.eq(part.weight, 0.0), -np.inf, term)
            for part, term in zip(before, terms, strict=True)
        ]
        largest = disconnected_grad(pt.max(pt.stack(possible)))
        joint = [
            part.weight * pt.exp(pt.minimum(term - largest, 0.0))
            for part, term in zip(before, terms, strict=True)
        ]
        total = total_of(joint)
        after = [Weighted(w / total, state) for w, state in zip(joint, analyses, strict=True)]
        return after, largest + pt.log(total)
