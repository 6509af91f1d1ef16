"""Which free variables of a model with a panel belong to single records, and the model's terms.

The posterior of a panel is a product over records, times what all records share. The free variables
are divided accordingly:

own
    The value has a row for each record, and each term of the log-density that it touches is a sum
    of terms of single records.
population
    No likelihood depends on it, given the others: the parameters of the distribution of own
    variables in the centred form, such as their mean.
shared
    All others. A variable of which it is not certain that it is own is shared.

Own variables are moved in coordinates in which the likelihoods depend on fewer of the others, where
there are such: see `centring`. Those of the centred form have such already, and their priors tell
in which others they would be non-centred.
"""

from collections import ChainMap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pytensor.graph.basic import Variable
from pytensor.graph.replace import clone_replace
from pytensor.graph.traversal import ancestors
from pytensor.scalar.basic import Add
from pytensor.tensor.elemwise import CAReduce
from pytensor.tensor.variable import TensorVariable

from .aligned_axes import Aligned, Mixed, Status, follow, records_of_rows
from .centring import Centring, centred_by_prior, centring_of
from .inspection import log_density_terms, panel_variables, state_space_nodes


class PanelStructure(NamedTuple):
    """The log-density of a model, divided by record.

    The log-density is the sum of all four graphs, less the log-Jacobians of the centrings.
    """

    name: str  # of the panel variable, whose records they are
    n_records: int
    own: tuple[TensorVariable, ...]  # values of free variables
    population: tuple[TensorVariable, ...]
    shared: tuple[TensorVariable, ...]
    centrings: tuple[Centring, ...]  # of own values, which the graphs then do not have
    centred: tuple[Centring, ...]  # of own values, which have these coordinates in the model
    likelihood: TensorVariable  # (G,), of the panels
    other_likelihood: TensorVariable | None  # (), of other data, if filters compute one
    prior: TensorVariable  # (G,), all other terms that own variables touch
    rest: TensorVariable  # (), all terms that are left

    @property
    def interwoven(self) -> list[TensorVariable]:
        """Of the values that records share, those of which locations and scales are made."""
        made_of = _made_of([*self.centrings, *self.centred])
        return [value for value in (*self.population, *self.shared) if value in made_of]


class _Terms(NamedTuple):
    """Summands of a log-density, and how they depend on own values."""

    likelihoods: list[TensorVariable]  # which filters compute
    others: list[TensorVariable]
    own: list[TensorVariable]
    status: dict[Variable, Status]

    @property
    def mixed(self) -> frozenset[Variable]:
        """The own values by which a term cannot be divided by record."""
        found = map(self.status.get, [*self.likelihoods, *self.others])
        values: frozenset[Variable] = frozenset()
        return values.union(*(one.values for one in found if isinstance(one, Mixed)))


def panel_structure(model: pm.Model, *, centres: bool = True) -> PanelStructure | None:
    """Divide the log-density of a model by the records of its panel.

    None without a panel of at least two records, or without variables that are own. With several
    panels, the records are those of the one that has most of them. Unless it ``centres`` them, all
    variables have the coordinates of the model.
    """
    sizes = {name: _n_records(model, name) for name in panel_variables(model)}
    if not sizes:
        return None
    name = max(sizes, key=lambda name: sizes[name])
    n_records, point = sizes[name], model.initial_point(random_seed=0)
    if n_records == 1:
        return None
    likelihoods: list[TensorVariable] = []
    others: list[TensorVariable] = []
    filtered = state_space_nodes(model)
    for variable, term in log_density_terms(model):
        (likelihoods if variable in filtered else others).extend(_summands(term))
    own = [
        value
        for value in map(model.rvs_to_values.get, model.free_RVs)
        if value.type.ndim and len(point[value.name]) == n_records
    ]
    terms = _followed(likelihoods, others, own, n_records, point)
    while mixed := terms.mixed:
        own = [value for value in own if value not in mixed]
        terms = _followed(likelihoods, others, own, n_records, point)
    if not own:
        return None
    common = [value for value in model.value_vars if value not in own]
    centrings = _centrings(terms, common, point) if centres else []
    if centrings:
        terms = _centred(terms, centrings, n_records, point)
        assert not terms.mixed  # as entries keep their rows
    centred = _centred_in_model(model, terms.own, common, point) if centres else []
    reached = set(ancestors(terms.likelihoods))
    likelihoods, other_likelihoods = _divided(terms.likelihoods, terms.status, n_records)
    priors, rest = _divided(terms.others, terms.status, n_records)
    return PanelStructure(
        name,
        n_records,
        tuple(own),
        tuple(value for value in common if value not in reached),
        tuple(value for value in common if value in reached),
        tuple(centrings),
        tuple(centred),
        _total(likelihoods, pt.zeros(n_records)),
        _total(other_likelihoods, pt.zeros(())) if other_likelihoods else None,
        _total(priors, pt.zeros(n_records)),
        _total(rest, pt.zeros(())),
    )


def _n_records(model: pm.Model, name: str) -> int:
    return int(records_of_rows(state_space_nodes(model)[name].inputs[3])[-1]) + 1


def _summands(term: TensorVariable) -> list[TensorVariable]:
    """The parts of a term whose sums over all their entries make up that of the term."""
    node = term.owner
    if node is None or not isinstance(node.op, CAReduce) or not isinstance(node.op.scalar_op, Add):
        return [term]
    return _summands(node.inputs[0])


def _followed(
    likelihoods: list[TensorVariable],
    others: list[TensorVariable],
    own: list[TensorVariable],
    n_records: int,
    point: Mapping[str, Any],
) -> _Terms:
    status = follow([*likelihoods, *others], own, n_records, point)
    return _Terms(likelihoods, others, own, status)


def _centrings(
    terms: _Terms, common: Sequence[Variable], point: Mapping[str, Any]
) -> list[Centring]:
    """The centrings of own values, without any of which a likelihood depends on more others."""
    found = [centring_of(value, terms.likelihoods, terms.status, point) for value in terms.own]

    def reached(centrings: list[Centring]) -> set[Variable]:
        return set(ancestors(_replaced(terms.likelihoods, centrings))).intersection(common)

    fewest = reached(found)
    return [
        one for one in found if reached([other for other in found if other is not one]) != fewest
    ]


def _centred_in_model(
    model: pm.Model,
    own: Sequence[TensorVariable],
    common: Sequence[Variable],
    point: Mapping[str, Any],
) -> list[Centring]:
    """Of the own values those with priors of locations and scales that all records share."""
    found = (centred_by_prior(value, model, point) for value in own)
    among, others = set(common), {*model.value_vars} - {*common}
    return [
        one
        for one in found
        if one is not None and among & (made_of := _made_of([one])) and not others & made_of
    ]


def _made_of(centrings: Sequence[Centring]) -> set[Variable]:
    """What locations and scales depend on."""
    return set(ancestors([at for one in centrings for at in (one.location, one.scale)]))


def _replaced(
    graphs: Sequence[TensorVariable], centrings: Sequence[Centring]
) -> list[TensorVariable]:
    """Graphs in the coordinates of centrings."""
    replaced = ChainMap(*(one.replaced for one in centrings))
    return clone_replace(list(graphs), dict(replaced))


def _centred(
    terms: _Terms, centrings: Sequence[Centring], n_records: int, point: Mapping[str, Any]
) -> _Terms:
    """The terms in the coordinates of centrings."""
    centred = {one.value: one.centred for one in centrings}
    likelihoods, others = (_replaced(graphs, centrings) for graphs in terms[:2])
    others += [one.log_jacobian for one in centrings]
    own = [centred.get(value, value) for value in terms.own]
    return _followed(likelihoods, others, own, n_records, point)


def _divided(
    graphs: Sequence[TensorVariable], status: Mapping[Variable, Status], n_records: int
) -> tuple[list[TensorVariable], list[TensorVariable]]:
    """Sums of graphs by record, (G,), and of those that belong to none."""
    by_record, whole = [], []
    for graph in graphs:
        found = status.get(graph)
        if isinstance(found, Aligned):
            by_record.append(_record_sums(graph, found, n_records))
        else:
            whole.append(pt.sum(graph))
    return by_record, whole


def _record_sums(graph: TensorVariable, found: Aligned, n_records: int) -> TensorVariable:
    """Sums of the entries of each record, (G,)."""
    axes = [axis for axis in range(graph.type.ndim) if axis != found.axis]
    entries = graph.sum(axis=axes) if axes else graph
    if found.records == tuple(range(n_records)):
        return entries
    return pt.zeros(n_records)[np.array(found.records)].inc(entries)


def _total(parts: Iterable[TensorVariable], zero: TensorVariable) -> TensorVariable:
    return sum(parts, start=zero)
