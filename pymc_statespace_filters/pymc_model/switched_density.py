"""A model's log-density with some of its scalars held at given values, chosen point by point.

A model in which a scalar is held has the joint density at that value over the density that the
scalar itself has there, given the others: what remains is a density of all other variables. It is
one graph for all sets of held scalars, with a switch for each of them, so that nothing is compiled
again. A held value enters the graph as it is, never transformed: zero has no logarithm.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from numpy.typing import NDArray
from pymc.logprob.basic import transformed_conditional_logp
from pymc.logprob.utils import replace_rvs_by_values
from pytensor.graph.basic import Variable
from pytensor.graph.replace import clone_replace
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .at_points import GraphsAtPoints
from .density import RowFunction, check_free_variables

Array = NDArray[np.float64]
Columns = NDArray[np.int64]


@dataclass(frozen=True)
class Switches:
    """Scalars of the flat unconstrained vector that K switches hold together."""

    columns: tuple[Columns, ...]  # of the vector, for each switch
    values: tuple[Array, ...]  # as the model's variables have them, at which these are held

    def __len__(self) -> int:
        return len(self.columns)

    def number_of(self, size: int) -> Columns:
        """The switch of every column, (size,); K where there is none."""
        number = np.full(size, len(self))
        for i, columns in enumerate(self.columns):
            number[columns] = i
        return number

    def held_at(self, size: int) -> Array:
        """The value at which every column is held, (size,); zero where there is none."""
        held = np.zeros(size)
        for columns, values in zip(self.columns, self.values, strict=True):
            held[columns] = values
        return held


class DensityInParts(NamedTuple):
    """The log-density of a model at points, and the priors of its blocks.

    ``own`` (m, blocks) is what the prior of each block, given others, adds to the total, with the
    Jacobian; zero if held. ``held`` (m, blocks) is the log-density of each block at the values at
    which it is held, given the others; it is no part of the total, and zero if nothing is held.
    """

    total: Array  # (m,), -inf instead of NaN
    own: Array
    held: Array


class SwitchedDensity(RowFunction):
    """The log-density of a model with some scalars held, at many points.

    Free variables are continuous, and the switches are of elements with densities of their own.
    ``blocks`` (k,) has for every column of the unconstrained vector the number of its block: an
    element, or a variable whose elements have a joint density alone. Raises `ModelError` if an
    element that is to be held has no density of its own.
    """

    def __init__(self, model: pm.Model, switches: Switches) -> None:
        check_free_variables(model)
        graphs = _SwitchedGraphs(model, switches)
        self.model, self._graphs = model, graphs
        self.blocks = graphs.blocks
        extra = [graphs.own_terms, graphs.held_terms]
        super().__init__(model, graphs.log_density, extra, point=graphs.point)

    def evaluate_in_parts(
        self, x: Array, is_on: NDArray[np.bool_], seeds: NDArray[np.int64]
    ) -> "DensityInParts":
        """The density at points x (m, k), and the priors of single blocks in it.

        ``is_on`` (m, K) has the switches: where one is off its scalars are held, and their columns
        of x have no influence.
        """
        found, own, held = self.calls(np.concatenate([x, is_on], axis=1), *seeds.T)
        return DensityInParts(np.where(np.isnan(found), -np.inf, found), own, held)

    def priors(self) -> "SwitchedPriors":
        """The priors of the blocks, without the likelihood."""
        return SwitchedPriors(self.model, self._graphs)

    def constrained(self, variables: Sequence[TensorVariable]) -> "SwitchedValues":
        """Variables of the model as functions of a point and its switches."""
        return SwitchedValues(self._graphs, variables)


class SwitchedPriors(RowFunction):
    """The priors of all blocks, without the likelihood: see `DensityInParts`."""

    def __init__(self, model: pm.Model, graphs: "_SwitchedGraphs") -> None:
        terms = [graphs.own_terms, graphs.held_terms]
        super().__init__(model, graphs.own_terms.sum(), terms, point=graphs.point)

    def in_parts(self, x: Array, is_on: NDArray[np.bool_]) -> DensityInParts:
        """At points x (m, k) with switches (m, K)."""
        seeds = np.broadcast_to(self.model_seeds, (len(x), self.model_seeds.size))
        return DensityInParts(*self.calls(np.concatenate([x, is_on], axis=1), *seeds.T))


class SwitchedValues:
    """Variables of a model, at points of the unconstrained space with some scalars held."""

    def __init__(self, graphs: "_SwitchedGraphs", variables: Sequence[TensorVariable]) -> None:
        self.names = [variable.name for variable in variables]
        self._at_points = GraphsAtPoints(graphs.model, graphs.values_of(variables), graphs.point)

    def __call__(self, x: Array, is_on: NDArray[np.bool_]) -> dict[str, np.ndarray]:
        """Values by name, (m, ...), at points x (m, k) with switches (m, K)."""
        found = self._at_points(np.concatenate([x, is_on], axis=1))
        return dict(zip(self.names, found, strict=True))


class _SwitchedGraphs:
    """The graphs of a `SwitchedDensity`; their inputs are the keys of ``point``."""

    def __init__(self, model: pm.Model, switches: Switches) -> None:
        start = model.initial_point()
        shapes = {rv: start[model.rvs_to_values[rv].name].shape for rv in model.free_RVs}
        self._on = pt.dvector("switches")
        self._number = _by_variable(shapes, switches.number_of(_size(shapes)))
        self._held = _by_variable(shapes, switches.held_at(_size(shapes)))
        self.n_switches = len(switches)
        # Free variables of which something is held; their values are symbols until `_completed`.
        self._symbols = {
            rv: rv.type(name=rv.name)
            for rv in model.free_RVs
            if (self._number[rv] < len(switches)).any()
        }
        self.model = model
        self._settings: dict[str, Any] = {
            "rvs_to_values": model.rvs_to_values | self._symbols,
            "rvs_to_transforms": model.rvs_to_transforms | dict.fromkeys(self._symbols),
        }
        self._values = self._values_of_symbols()
        terms = dict(
            zip(
                model.basic_RVs,
                transformed_conditional_logp(model.basic_RVs, **self._settings),
                strict=True,
            )
        )
        free = {rv: terms.pop(rv) for rv in model.free_RVs}
        own = {rv: self._own_term(rv, term) for rv, term in free.items()}
        held = {rv: self._held_term(rv, free[rv], term) for rv, term in own.items()}
        others = [*terms.values(), *replace_rvs_by_values(model.potentials, **self._settings)]
        of_own, of_held = (
            pt.concatenate([pt.flatten(term) for term in each.values()]) for each in (own, held)
        )
        total: Any = sum([term.sum() for term in others], start=of_own.sum())
        self.log_density, self.own_terms, self.held_terms = self._completed(
            [total, of_own, of_held]
        )
        self.blocks = _blocks(shapes, own)
        values = [model.rvs_to_values[rv] for rv in model.free_RVs]
        self.point = {value: start[value.name] for value in values}
        self.point[self._on] = np.ones(len(switches))

    def values_of(self, variables: Sequence[TensorVariable]) -> list[Variable]:
        """Variables of the model as graphs of the inputs."""
        return self._completed(replace_rvs_by_values(list(variables), **self._settings))

    def _values_of_symbols(self) -> dict[Variable, Variable]:
        """What the symbols stand for; it may contain those of variables before them."""
        found: dict[Variable, Variable] = {}
        for rv, symbol in self._symbols.items():
            value, transform = self.model.rvs_to_values[rv], self.model.rvs_to_transforms[rv]
            if transform is not None:
                (value,) = replace_rvs_by_values(
                    [transform.backward(value, *rv.owner.inputs)], **self._settings
                )
            switched = pt.switch(self._is_on(rv), value, self._held[rv])
            found[symbol] = symbol.type.filter_variable(switched, allow_convert=True)
        return found

    def _completed(self, graphs: Sequence[Variable]) -> list[Variable]:
        """Graphs in which the symbols are replaced by what they stand for."""
        completed = list(graphs)
        for symbol in reversed(self._symbols.values()):
            completed = clone_replace(completed, {symbol: self._values[symbol]})
        return completed

    def _own_term(self, rv: TensorVariable, term: TensorVariable) -> TensorVariable:
        """The log-density of a free variable given others, with its Jacobian; zero where held."""
        is_elementwise = _is_elementwise(rv, self.model)
        if rv not in self._symbols:
            return term if is_elementwise else term.sum()
        if not is_elementwise:
            raise ModelError(
                f"absent must name scalars with a density of their own, got an element of "
                f"{rv.name!r}, whose elements have a joint density "
                f"({type(rv.owner.op).__name__}): give each of them a variable or a prior of its "
                "own"
            )
        transform = self.model.rvs_to_transforms[rv]
        if transform is not None:
            value = self.model.rvs_to_values[rv]
            (jacobian,) = replace_rvs_by_values(
                [transform.log_jac_det(value, *rv.owner.inputs)], **self._settings
            )
            term = term + jacobian
        return pt.switch(self._is_on(rv), term, 0.0)

    def _held_term(
        self, rv: TensorVariable, term: TensorVariable, own: TensorVariable
    ) -> TensorVariable:
        """The log-density of a free variable where it is held; zero where it is not."""
        return pt.switch(self._is_on(rv), 0.0, term) if rv in self._symbols else pt.zeros_like(own)

    def _is_on(self, rv: TensorVariable) -> TensorVariable:
        """Whether the elements of a variable are not held."""
        flat = [
            self._on[number] > 0.5 if number < self.n_switches else pt.constant(True)
            for number in self._number[rv].flat
        ]
        return pt.stack(flat).reshape(self._number[rv].shape)


def _is_elementwise(rv: TensorVariable, model: pm.Model) -> bool:
    """Whether each element of a free variable has a density of its own, given other variables."""
    transform = model.rvs_to_transforms[rv]
    is_scalar = getattr(rv.owner.op, "ndim_supp", None) == 0
    return is_scalar and (transform is None or transform.ndim_supp == 0)


def _size(shapes: Mapping[TensorVariable, tuple[int, ...]]) -> int:
    return sum(int(np.prod(shape)) for shape in shapes.values())


def _by_variable(shapes: Mapping[TensorVariable, tuple[int, ...]], flat: NDArray) -> dict:
    """Parts of an array over the flat vector, in the shapes of the variables."""
    sizes = [int(np.prod(shape)) for shape in shapes.values()]
    parts = np.split(flat, np.cumsum(sizes)[:-1])
    return {rv: part.reshape(shapes[rv]) for rv, part in zip(shapes, parts, strict=True)}


def _blocks(
    shapes: Mapping[TensorVariable, tuple[int, ...]], own: Mapping[TensorVariable, TensorVariable]
) -> Columns:
    found: list[Columns] = []
    first = 0
    for rv, shape in shapes.items():
        size = int(np.prod(shape))
        n_blocks = size if own[rv].type.ndim == len(shape) else 1
        found.append(first + np.minimum(np.arange(size), n_blocks - 1))
        first += n_blocks
    return np.concatenate(found)
