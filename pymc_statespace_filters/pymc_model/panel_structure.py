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
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import ancestors
from pytensor.scalar.basic import Add
from pytensor.tensor.elemwise import CAReduce
from pytensor.tensor.variable import TensorVariable

from .aligned_axes import Aligned, Mixed, Status, follow, records_of_rows
from .inspection import log_density_terms, panel_variables, state_space_nodes


class PanelStructure(NamedTuple):
    """The log-density of a model, divided by record.

    The log-density is the sum of all four graphs.
    """

    name: str  # of the panel variable, whose records they are
    n_records: int
    own: tuple[TensorVariable, ...]  # values of free variables
    population: tuple[TensorVariable, ...]
    shared: tuple[TensorVariable, ...]
    likelihood: TensorVariable  # (G,), of the panels
    other_likelihood: TensorVariable | None  # (), of other data, if filters compute one
    prior: TensorVariable  # (G,), all other terms that own variables touch
    rest: TensorVariable  # (), all terms that are left


def panel_structure(model: pm.Model) -> PanelStructure | None:
    """Divide the log-density of a model by the records of its panel.

    None without a panel of at least two records, or without variables that are own. With several
    panels, the records are those of the one that has most of them.
    """
    sizes = {name: _n_records(model, name) for name in panel_variables(model)}
    if not sizes:
        return None
    name = max(sizes, key=lambda name: sizes[name])
    n_records, point = sizes[name], model.initial_point(random_seed=0)
    if n_records == 1:
        return None
    own = [
        value
        for value in map(model.rvs_to_values.get, model.free_RVs)
        if value.type.ndim and len(point[value.name]) == n_records
    ]
    terms = [(name, part) for name, term in log_density_terms(model) for part in _summands(term)]
    graphs = [graph for _, graph in terms]
    status: dict[Variable, Status] = {}
    while own:
        status = follow(graphs, own, n_records, point)
        mixed = [found for found in map(status.get, graphs) if isinstance(found, Mixed)]
        if not mixed:
            break
        own = [value for value in own if not any(value in one.values for one in mixed)]
    if not own:
        return None
    return _divided(model, name, n_records, own, terms, status)


def _n_records(model: pm.Model, name: str) -> int:
    return int(records_of_rows(state_space_nodes(model)[name].inputs[3])[-1]) + 1


def _summands(term: TensorVariable) -> list[TensorVariable]:
    """The parts of a term whose sums over all their entries make up that of the term."""
    node = term.owner
    if node is None or not isinstance(node.op, CAReduce) or not isinstance(node.op.scalar_op, Add):
        return [term]
    return _summands(node.inputs[0])


def _divided(
    model: pm.Model,
    name: str,
    n_records: int,
    own: Sequence[TensorVariable],
    terms: Sequence[tuple[str, TensorVariable]],
    status: dict[Variable, Status],
) -> PanelStructure:
    likelihoods = set(state_space_nodes(model))
    by_record: dict[bool, list[TensorVariable]] = {True: [], False: []}
    whole: dict[bool, list[TensorVariable]] = {True: [], False: []}
    for of_variable, graph in terms:
        is_likelihood, found = of_variable in likelihoods, status.get(graph)
        if isinstance(found, Aligned):
            by_record[is_likelihood].append(_record_sums(graph, found, n_records))
        else:
            whole[is_likelihood].append(pt.sum(graph))
    reached = set(ancestors([*by_record[True], *whole[True]]))
    others = [value for value in model.value_vars if value not in own]
    return PanelStructure(
        name,
        n_records,
        tuple(own),
        tuple(value for value in others if value not in reached),
        tuple(value for value in others if value in reached),
        _total(by_record[True], pt.zeros(n_records)),
        _total(whole[True], pt.zeros(())) if whole[True] else None,
        _total(by_record[False], pt.zeros(n_records)),
        _total(whole[False], pt.zeros(())),
    )


def _record_sums(graph: TensorVariable, found: Aligned, n_records: int) -> TensorVariable:
    """Sums of the entries of each record, (G,)."""
    axes = [axis for axis in range(graph.type.ndim) if axis != found.axis]
    entries = graph.sum(axis=axes) if axes else graph
    if found.records == tuple(range(n_records)):
        return entries
    return pt.zeros(n_records)[np.array(found.records)].inc(entries)


def _total(parts: Iterable[TensorVariable], zero: TensorVariable) -> TensorVariable:
    return sum(parts, start=zero)
