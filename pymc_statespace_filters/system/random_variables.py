"""PyMC distributions that a user's function returns, as functions of standard normals.

Each random variable in what ``process_dist`` or ``initial_dist`` returns becomes a function of
normals at places of their own, so that a step is a deterministic function of state and normals.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pytensor.tensor as pt
from pytensor.compile.builders import OpFromGraph
from pytensor.graph.basic import Apply, Constant, Variable
from pytensor.graph.traversal import ancestors, io_toposort
from pytensor.tensor.elemwise import Elemwise
from pytensor.tensor.math import Prod, Sum
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.subtensor import BaseSubtensor
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from . import distributions
from .equations import Equation, as_symbol, folded_constants, static_shape
from .graph_digest import is_made_after

Values = Mapping[str, TensorVariable]


@dataclass(frozen=True)
class Drawn:
    """Components drawn from distributions, as functions of standard normals.

    ``exact`` has the law that the user wrote. In ``surrogate`` each variable is normal, with its
    mean and variance given the variables above it; it is linear in the normals to first order.
    ``is_gaussian`` tells whether the components are known to be jointly normal given the state.
    ``is_valid`` tells whether no draw of ``exact`` is NaN, as one of invalid parameters is.
    ``given`` are the components given the values of the finite variables; None if there are none.
    """

    normals: TensorVariable
    exact: TensorVariable
    surrogate: TensorVariable
    is_valid: TensorVariable
    is_discrete: bool
    is_gaussian: bool
    given: "GivenValues | None" = None

    def where_valid(self, vector: TensorVariable) -> TensorVariable:
        """What is made of ``exact``, NaN where a draw is: a comparison with NaN is only false."""
        return vector if self.is_gaussian else pt.switch(self.is_valid, vector, np.nan)


@dataclass(frozen=True)
class GivenValues:
    """Components given the values of all variables that take finitely many.

    ``values`` (n_v,) has the numbers of these variables, those of parents first. The others are
    normal ones as in ``surrogate``, and exact if ``others_are_gaussian``. ``law`` (4 n_v,) holds,
    given the values before it, the probability of each value, whether its parameters are valid, and
    its smallest and largest value.
    """

    values: TensorVariable
    entries: TensorVariable
    law: TensorVariable
    others_are_gaussian: bool


def trace_distributions(
    equation: Equation, values: Values, theta: TensorVariable, name: str
) -> Drawn:
    """Call a function that returns distributions; its normals are the vector ``name``.

    Random variables older than ``theta`` are not the function's own, and are refused.
    """
    role, entries = equation.role, _entries(equation, values)
    nodes = io_toposort([], entries)
    variables = [node for node in nodes if is_drawn(node)]
    _check_own(role, variables, theta)
    laws = [_law_of(role, node) for node in variables]
    sizes = [
        law.count(_shape(node), distributions.parameters_of(node))
        for law, node in zip(laws, variables, strict=True)
    ]
    for node in variables:
        _check_one_vector(role, node)
        _check_constants(role, node)
    normals = pt.tensor(name, shape=(sum(sizes),), dtype="float64")
    places = {
        node: normals[int(end) - size : int(end)]
        for node, size, end in zip(variables, sizes, np.cumsum(sizes, dtype=int), strict=True)
    }

    def drawn(node: Apply, parameters: Sequence[TensorVariable]) -> TensorVariable:
        return _law_of(role, node).draw(places[node], _shape(node), parameters)

    def normal(node: Apply, parameters: Sequence[TensorVariable]) -> TensorVariable:
        return _law_of(role, node).surrogate(places[node], _shape(node), parameters)

    exact, draws = _replaced(role, entries, nodes, drawn)
    surrogate, _ = _replaced(role, entries, nodes, normal)
    return Drawn(
        normals,
        exact,
        surrogate,
        ~pt.any(pt.concatenate([pt.isnan(draw).ravel() for draw in (normals, *draws)])),
        any(law.is_discrete for law in laws),
        all(law.is_gaussian for law in laws) and _are_separate(entries, variables),
        _given_values(role, entries, nodes, normal),
    )


def _given_values(
    role: str,
    entries: Sequence[TensorVariable],
    nodes: Sequence[Apply],
    normal: Callable[[Apply, Sequence[TensorVariable]], TensorVariable],
) -> GivenValues | None:
    """The components given the values of the finite variables."""
    variables = [node for node in nodes if is_drawn(node)]
    finite = [node for node in variables if type(node.op) in distributions.FINITE_LAWS]
    if not finite:
        return None
    ends = np.cumsum([int(np.prod(_shape(node), dtype=int)) for node in finite]).tolist()
    values = pt.tensor("v", shape=(ends[-1],), dtype="float64")
    starts = dict(zip(finite, [0, *ends[:-1]], strict=True))
    laws: list[Sequence[TensorVariable]] = []

    def value(node: Apply, parameters: Sequence[TensorVariable]) -> TensorVariable:
        if node not in starts:
            return normal(node, parameters)
        shape, law = _shape(node), distributions.FINITE_LAWS[type(node.op)]
        size = int(np.prod(shape, dtype=int))
        own = values[starts[node] : starts[node] + size].reshape(shape)
        numbers = (law.probability(own, *parameters), law.is_valid(*parameters))
        parts = (*numbers, *law.bounds(*parameters))
        laws.append([pt.broadcast_to(pt.cast(p, "float64"), shape).ravel() for p in parts])
        return own

    given, _ = _replaced(role, entries, nodes, value)
    law = pt.concatenate([part for parts in zip(*laws, strict=True) for part in parts])
    others = [_law_of(role, node) for node in variables if node not in starts]
    return GivenValues(
        values, given, pt.specify_shape(law, (4 * ends[-1],)), all(o.is_gaussian for o in others)
    )


def _entries(equation: Equation, values: Values) -> list[TensorVariable]:
    """What the function returned, as a list of symbols."""
    returned = equation(values)
    entries = list(returned) if isinstance(returned, list | tuple) else [returned]
    if not entries:
        raise ModelError(f"{equation.role} must return at least one distribution, got none")
    symbols = []
    for entry in entries:
        symbol = entry if isinstance(entry, TensorVariable) else as_symbol(equation.role, entry)
        if symbol.type.ndim > 1:
            raise ModelError(
                f"{equation.role} must return scalar or vector distributions, got one of "
                f"{symbol.type.ndim} dimensions; write one distribution for each vector"
            )
        symbols.append(symbol)
    return symbols


def _check_own(role: str, variables: Sequence[Apply], theta: TensorVariable) -> None:
    for node in variables:
        if not is_made_after(node.outputs[-1], [theta]):
            raise ModelError(
                f"{role} must use its arguments and constants only, got the random variable "
                f"{node.outputs[-1]}; pass it as a parameter"
            )


def is_drawn(node: Apply) -> bool:
    """Whether a node draws a random variable."""
    if not isinstance(node.op, OpFromGraph):  # as those of PyMC are, which takes long to import
        return isinstance(node.op, RandomVariable)
    from pymc.distributions.distribution import SymbolicRandomVariable

    return isinstance(node.op, SymbolicRandomVariable)


def _law_of(role: str, node: Apply) -> "distributions.Law":
    law = distributions.LAWS.get(type(node.op))
    if law is None:
        known = ", ".join(sorted(map(distributions.law_name, distributions.LAWS)))
        raise ModelError(
            f"{role} cannot draw {_name(node)} as a function of standard normals; it knows {known}."
            " Write others by these: a Poisson inflated by zeros is pm.Bernoulli.dist(p) * "
            "pm.Poisson.dist(mu)"
        )
    return law


def _name(node: Apply) -> str:
    return distributions.law_name(type(node.op))


def _output(node: Apply) -> TensorVariable:
    return node.outputs[1]


def _shape(node: Apply) -> tuple[int, ...]:
    shape = static_shape(_output(node))
    known = tuple(length for length in shape if length is not None)
    if len(known) < len(shape):
        raise ModelError(f"distributions must have a static shape, got {node.op} of shape {shape}")
    return known


def _check_one_vector(role: str, node: Apply) -> None:
    """Raise for several vectors in one variable."""
    shape = _shape(node)
    if node.op.ndim_supp == 1 and len(shape) != 1:
        raise ModelError(
            f"{role} must draw one vector by each {_name(node)}, got shape {shape}; "
            "write one distribution for each vector"
        )


def _check_constants(role: str, node: Apply) -> None:
    """Raise for a parameter that is a number outside its domain."""
    parameters = distributions.parameters_of(node)
    folded = folded_constants(parameters)
    for (name, domain), value in zip(_law_of(role, node).domains.items(), folded, strict=True):
        if isinstance(value, Variable):
            if not isinstance(value, Constant):
                continue
            value = value.data
        if not np.all(domain.holds(np.asarray(value, dtype="float64"))):
            raise ModelError(
                f"{role}: {name} of {_name(node)} must be {domain.text}, got "
                f"{np.asarray(value).tolist()}"
            )


def _replaced(
    role: str,
    entries: Sequence[TensorVariable],
    nodes: Sequence[Apply],
    replacement: Callable[[Apply, Sequence[TensorVariable]], TensorVariable],
) -> tuple[TensorVariable, list[Variable]]:
    """The entries in one vector, with random variables replaced; and these replacements.

    A replacement is made of the variable and its parameters.
    """
    known: dict[Variable, Variable] = {}
    for node in nodes:
        inputs = [known.get(variable, variable) for variable in node.inputs]
        if isinstance(node.op, Elemwise) and node.outputs[0].type.dtype == "float32":
            # Of constants: PyMC's 1 / 3.0 would be a third to seven digits.
            inputs = [pt.cast(variable, "float64") for variable in inputs]
        if is_drawn(node):
            parameters = [pt.cast(value, "float64") for value in inputs[2:]]
            known[_output(node)] = pt.specify_shape(replacement(node, parameters), _shape(node))
        elif inputs != node.inputs:
            known.update(zip(node.outputs, _rebuilt(role, node, inputs), strict=True))
    symbols = [as_symbol(role, known.get(entry, entry)) for entry in entries]
    parts = [symbol.dimshuffle("x") if symbol.type.ndim == 0 else symbol for symbol in symbols]
    return pt.concatenate(parts), [known[_output(node)] for node in nodes if is_drawn(node)]


def _rebuilt(role: str, node: Apply, inputs: Sequence[Variable]) -> list[Variable]:
    """The outputs of an operation with draws, which are double-precision, among its inputs."""
    if isinstance(node.op, Sum | Prod):  # of whole numbers, which accumulate as such
        return [type(node.op)(axis=node.op.axis)(*inputs)]
    if isinstance(node.op, BaseSubtensor):
        indices = node.inputs[1:]
        kept = [_as_whole(new, old) for new, old in zip(inputs[1:], indices, strict=True)]
        inputs = [inputs[0], *kept]
    try:
        return node.clone_with_new_inputs(list(inputs), strict=False).outputs
    except Exception as error:
        raise ModelError(
            f"{role} must use what it draws as a number, got it in {node.op} ({error}); where it "
            "is an index or a truth value, write pt.switch(pt.eq(draw, 0), a, b)"
        ) from error


def _as_whole(new: Variable, index: Variable) -> Variable:
    """A draw that is an index, which is a whole number, as such."""
    return new if new.type == index.type else pt.cast(new, index.type.dtype)


def _are_separate(entries: Sequence[TensorVariable], variables: Sequence[Apply]) -> bool:
    """Whether every entry is a variable or free of them, and no variable depends on another."""
    drawn = {_output(node) for node in variables}
    for entry in entries:
        if entry not in drawn and drawn & set(ancestors([entry])):
            return False
    return not any(drawn & set(ancestors(distributions.parameters_of(node))) for node in variables)
