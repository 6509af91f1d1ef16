"""A model with another filter than the user gave it, as a model of its own."""

import json
from collections.abc import Mapping
from typing import Any

import pymc as pm
import xarray as xr
from pymc.model.fgraph import fgraph_from_model, model_from_fgraph
from pytensor.compile.sharedvalue import SharedVariable

from ..errors import ModelError
from ..filters.checks import check_system_and_filter
from ..filters.protocol import Filter
from ..filters.written import filter_from
from .inspection import filters_used, given_model, is_filter, state_space_nodes
from .posterior_draws import BY_PARTICLES, check_same_rows
from .random_variable import make_seed


def model_with_filters(model: pm.Model, filters: Mapping[str, Filter]) -> pm.Model:
    """A copy of a model in which some StateSpace variables, by name, have another filter.

    Raises `ModelError` if a filter cannot treat the system.
    """
    fgraph, memo = fgraph_from_model(_without_initial_values(model), inlined_views=True)
    seeds = {}
    for name, node in state_space_nodes(model).items():
        if (filter := filters.get(name)) is None:
            continue
        check_system_and_filter(node.op.system, filter)
        drawn = memo[node.outputs[1]].owner.inputs[0]
        *arguments, seed = drawn.owner.inputs
        if filter.noisy and not isinstance(node.inputs[-1], SharedVariable):
            seed = seeds[name] = make_seed(name, node.inputs[-1].data)
        new = node.op.with_filter(filter).make_node(*arguments, seed)
        fgraph.replace(drawn, new.outputs[1], import_missing=True)
    found = model_from_fgraph(fgraph, mutate_fgraph=True)
    for seed in seeds.values():
        found.register_data_var(seed)
    return found


def _without_initial_values(model: pm.Model) -> pm.Model:
    """The same variables without initial values, which no density depends on: PyMC copies none."""
    plain = object.__new__(type(model))  # copy.copy would clone the graphs
    plain.__dict__.update(model.__dict__)
    plain.rvs_to_initial_values = dict.fromkeys(model.rvs_to_initial_values)
    return plain


def model_with(model: pm.Model, name: str, filter: Any) -> pm.Model:
    """A model whose StateSpace variables all have a filter, the argument ``name`` of a user.

    Raises `ModelError` if it is no filter, cannot treat a system, or there is no such variable.
    """
    if not is_filter(filter):
        raise ModelError(f"{name} must be a filter, such as psf.EnKF(200), got {filter!r}")
    if not (nodes := state_space_nodes(model)):
        raise ModelError(f"{name} must be None for a model without a StateSpace variable")
    return model_with_filters(model, dict.fromkeys(nodes, filter))


def model_of_draws(model: pm.Model | None, idata: Any) -> pm.Model:
    """The given model, with the filters by which draws of `sample_smc` were made.

    Those had another one inside, or more members at the end. A filter of a user's own class stays.
    Raises `DataMismatchError` if a sequential run has seen other data than those of the model.
    """
    model = given_model(model)
    if not isinstance(idata, xr.DataTree) or idata.attrs.get("sampler") != BY_PARTICLES:
        return model
    check_same_rows(idata, model)
    used = json.loads(idata.attrs.get("filter", "{}"))
    own = json.loads(filters_used(model).get("filter", "{}"))
    filters = {
        name: filter
        for name, text in used.items()
        if name in own and text != own[name] and (filter := filter_from(text)) is not None
    }
    return model_with_filters(model, filters) if filters else model
