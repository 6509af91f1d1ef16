"""Random effects in the coordinates in which they enter the likelihoods.

A value v with a row for each record enters the likelihoods of a hierarchical model in the
non-centred form as a + b v alone, or as exp(a + b v), where a and b are made of what all records
share. In the centred coordinates c = a + b v no likelihood depends on a and b, unless by another
way. A chain can then move the parameters of the population without a likelihood, and each record by
itself, at a scale that its own data give. The change of coordinates is exact: with v = (c - a) / b
the log-density is that of the model, and the log-Jacobian -log|b| for each entry. In the centred
form c is a variable of the model, and its prior names a and b.

References
----------
A. E. Gelfand, S. K. Sahu and B. P. Carlin (1995). Efficient parametrisations for normal linear
mixed models. Biometrika 82, 479-488.
O. Papaspiliopoulos, G. O. Roberts and M. Sköld (2007). A general framework for the parametrization
of hierarchical models. Statistical Science 22, 59-73.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pymc.logprob.transforms import LogTransform
from pytensor.graph.basic import Apply, Constant, Variable
from pytensor.graph.rewriting.utils import rewrite_graph
from pytensor.graph.traversal import applys_between
from pytensor.scalar.basic import Add, Exp, Identity, Mul, Neg, Pow, Sub, TrueDiv
from pytensor.scalar.math import Sigmoid
from pytensor.tensor.elemwise import DimShuffle, Elemwise
from pytensor.tensor.shape import Shape, Shape_i
from pytensor.tensor.subtensor import AdvancedSubtensor, Subtensor
from pytensor.tensor.variable import TensorVariable

from .aligned_axes import Status, evaluated

Clients = Mapping[Variable, Sequence[Apply]]


class Centring(NamedTuple):
    """The coordinates c = a + b v of a value v."""

    value: TensorVariable  # v
    centred: TensorVariable  # c, a symbol of the same name and shape
    location: TensorVariable  # a, for every entry of v
    scale: TensorVariable  # b
    # Graphs of v, with what they are in c.
    entries: dict[TensorVariable, TensorVariable]

    @property
    def log_jacobian(self) -> TensorVariable:
        """The logarithm of dv / dc, by entry."""
        return -pt.log(pt.abs(self.scale))

    @property
    def replaced(self) -> dict[TensorVariable, TensorVariable]:
        """What to replace in a graph, so that it depends on c instead of v."""
        return {self.value: (self.centred - self.location) / self.scale, **self.entries}


class _Place(NamedTuple):
    """Where a distribution has its location among its parameters, with the scale behind it."""

    number: int
    transform: type = type(None)  # of the variable, whose value has them


_LOCATIONS = {
    type(pm.Normal.rv_op): _Place(0),
    type(pm.LogNormal.rv_op): _Place(0, LogTransform),
    type(pm.Laplace.rv_op): _Place(0),
    type(pm.Logistic.rv_op): _Place(0),
    type(pm.StudentT.rv_op): _Place(1),
}


class _Affine(NamedTuple):
    """A graph that is a + b v, or its exponential, with further axes of length 1."""

    graph: TensorVariable
    a: TensorVariable
    b: TensorVariable
    further: tuple[int, ...] = ()
    is_exp: bool = False

    def at(self, c: TensorVariable) -> TensorVariable:
        """The graph if a + b v is c."""
        entries = pt.expand_dims(c, self.further)
        return pt.exp(entries) if self.is_exp else entries

    @property
    def location(self) -> TensorVariable:
        """a, without the further axes."""
        return pt.squeeze(self._padded(self.a), self.further)

    @property
    def scale(self) -> TensorVariable:
        """b, without the further axes."""
        return pt.squeeze(self._padded(self.b), self.further)

    def _padded(self, numbers: TensorVariable) -> TensorVariable:
        return pt.shape_padleft(numbers, self.graph.type.ndim - numbers.type.ndim)

    def shuffled(self, node: Apply) -> "_Affine | None":
        """The function after a `DimShuffle`, if that only adds axes."""
        order = node.op.new_order
        if [axis for axis in order if axis != "x"] != list(range(self.graph.type.ndim)):
            return None
        added = [i for i, axis in enumerate(order) if axis == "x" or axis in self.further]
        a, b = (self._padded(numbers).dimshuffle(order) for numbers in (self.a, self.b))
        return _Affine(node.outputs[0], a, b, tuple(added), self.is_exp)


def centring_of(
    value: TensorVariable,
    likelihoods: Sequence[Variable],
    status: Mapping[Variable, Status],
    point: Mapping[str, Any],
) -> Centring:
    """The coordinates in which a value enters the likelihoods, as far as they are seen.

    It has a row for each record; the columns of a table may enter each on its own. The status is
    that of what depends on values that belong to single records, see `follow`.
    """
    clients = _clients(value, likelihoods)
    n_columns = np.shape(point[value.name])[-1]
    columns = {_column(node, n_columns): node.outputs[0] for node in clients.get(value, ())}
    if None in columns or len(columns) < len(clients.get(value, ())):
        columns = {}
    parts = [_largest(part, clients, status, point) for part in (columns.values() or [value])]
    centred = value.type(name=value.name)
    location, scale = pt.zeros(centred.shape), pt.ones(centred.shape)
    if not columns:
        (whole,) = parts
        entries = {whole.graph: whole.at(centred)}
        return Centring(value, centred, location + whole.location, scale * whole.scale, entries)
    entries = {}
    for column, part in zip(columns, parts, strict=True):
        location = location[:, column].set(part.location)
        scale = scale[:, column].set(part.scale)
        entries[part.graph] = part.at(centred[:, column])
    return Centring(value, centred, location, scale, entries)


def centred_by_prior(
    value: TensorVariable, model: pm.Model, point: Mapping[str, Any]
) -> Centring | None:
    """The coordinates c that a value has in the model, if its prior has a location and a scale.

    v = (c - a) / b is then a standard variable: its prior has no parameters of the population.
    """
    rv = model.values_to_rvs.get(value)
    place = _LOCATIONS.get(type(rv.owner.op)) if rv is not None else None
    if place is None or type(model.rvs_to_transforms[rv]) is not place.transform:
        return None
    of_prior = rv.owner.op.dist_params(rv.owner)[place.number : place.number + 2]
    location, scale = (
        pt.broadcast_to(number, np.shape(point[value.name]))
        for number in model.replace_rvs_by_values(of_prior)
    )
    return Centring(value, value, location, scale, {})


def _clients(value: Variable, graphs: Sequence[Variable]) -> Clients:
    """The nodes that use a variable on the way from the value to the graphs, once for each use."""
    clients: dict[Variable, list[Apply]] = {}
    for node in applys_between([value], graphs):
        if not isinstance(node.op, Shape | Shape_i):
            for variable in node.inputs:
                clients.setdefault(variable, []).append(node)
    return clients


def _column(node: Apply, n_columns: int) -> int | None:
    """The column of a table that a node takes, from the first; None if it does something else."""
    if not isinstance(node.op, Subtensor) or node.op.idx_list[:1] != (slice(None),):
        return None
    if len(node.inputs) != 2 or len(node.op.idx_list) != 2 or node.outputs[0].type.ndim != 1:
        return None
    number = node.inputs[1]
    return int(number.data) % n_columns if isinstance(number, Constant) else None


def _largest(
    start: TensorVariable,
    clients: Clients,
    status: Mapping[Variable, Status],
    point: Mapping[str, Any],
) -> _Affine:
    """The last of the affine functions on the way from a variable, of its shape."""
    found = [_Affine(start, pt.zeros(()), pt.ones(()))]
    found += _on_the_way(found[0], clients, status)
    first, *shapes = evaluated([part.graph.shape for part in found], point)
    for before, part, shape in zip(found, found[1:], shapes, strict=False):
        if tuple(shape) != np.expand_dims(np.empty(first), part.further).shape:
            return before
    return found[-1]


def _on_the_way(
    part: _Affine, clients: Clients, status: Mapping[Variable, Status]
) -> Iterator[_Affine]:
    while len(users := clients.get(part.graph, ())) == 1:
        after = None
        if isinstance(users[0].op, DimShuffle):
            after = part.shuffled(users[0])
        elif isinstance(users[0].op, Elemwise):
            others = [variable for variable in users[0].inputs if variable is not part.graph]
            if not any(map(status.get, others)):
                after = (_after_exp if part.is_exp else _after)(users[0], part, others)
        if after is None:
            return
        yield (part := after)


def _after(node: Apply, part: _Affine, others: Sequence[Any]) -> _Affine | None:
    """The function after an operation with variables that all records share."""
    a, b, is_first = part.a, part.b, node.inputs[0] is part.graph
    after = part._replace(graph=node.outputs[0])
    match node.op.scalar_op:
        case Identity():
            return after
        case Exp():
            return after._replace(is_exp=True)
        case Neg():
            return after._replace(a=-a, b=-b)
        case Add():
            return after._replace(a=sum(others, start=a))
        case Sub() if is_first:
            return after._replace(a=a - others[0])
        case Sub():
            return after._replace(a=others[0] - a, b=-b)
        case Mul() if all(map(_has_sign, others)):
            factor = math.prod(others)
            return after._replace(a=a * factor, b=b * factor)
        case TrueDiv() if is_first and _has_sign(others[0]):
            return after._replace(a=a / others[0], b=b / others[0])
    return None


def _after_exp(node: Apply, part: _Affine, others: Sequence[Any]) -> _Affine | None:
    """The exponential after an operation with positive variables that all records share."""
    after = part._replace(graph=node.outputs[0])
    if not all(map(_is_positive, others)):
        return None
    match node.op.scalar_op:
        case Identity():
            return after
        case Mul():
            return after._replace(a=sum(map(pt.log, others), start=part.a))
        case TrueDiv() if node.inputs[0] is part.graph:
            return after._replace(a=part.a - pt.log(others[0]))
        case TrueDiv():
            return after._replace(a=pt.log(others[0]) - part.a, b=-part.b)
    return None


def _has_sign(variable: Variable) -> bool:
    """Whether a variable cannot come to zero, where a scale has no inverse."""
    if isinstance(variable, Constant):
        return bool(np.all(variable.data != 0.0))
    return _is_positive(variable)


def _is_positive(variable: Variable) -> bool:
    """Whether a variable is positive by the way in which it is made.

    Simplified, as the transform of an interval chooses by its ends, and adds them where they are
    zero.
    """
    return _made_positive(rewrite_graph(variable, include=("canonicalize", "stabilize")))


def _made_positive(variable: Variable) -> bool:
    if isinstance(variable, Constant):
        return bool(np.all(variable.data > 0.0))
    node = variable.owner
    if node is None:
        return False
    if isinstance(node.op, DimShuffle | Subtensor | AdvancedSubtensor):
        return _made_positive(node.inputs[0])
    match node.op.scalar_op if isinstance(node.op, Elemwise) else None:
        case Exp() | Sigmoid():
            return True
        case Sub():
            one, share = node.inputs
            op = share.owner.op if share.owner is not None else None
            is_share = isinstance(op, Elemwise) and isinstance(op.scalar_op, Sigmoid)
            return is_share and isinstance(one, Constant) and bool(np.all(one.data == 1.0))
        case Pow():
            return _made_positive(node.inputs[0])
        case Add() | Mul() | TrueDiv() | Identity():
            return all(map(_made_positive, node.inputs))
    return False
