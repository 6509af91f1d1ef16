"""Queries about the StateSpace variables of a PyMC model: filters, seeds, likelihood terms."""

import json
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.traversal import ancestors
from pytensor.tensor.basic import Join
from pytensor.tensor.math import variadic_add
from pytensor.tensor.shape import SpecifyShape
from pytensor.tensor.variable import TensorVariable

from ..compiler.lowering.compiled_system import compile_system
from ..errors import ModelError
from ..filters.protocol import Filter
from ..filters.written import short_form
from ..ops.likelihood import LogLikelihood
from ..system.missing_codes import has_missing_codes
from ..system.panel_records import RECORD
from .random_variable import PanelRV, StateSpaceRV


def given_model(model: pm.Model | None) -> pm.Model:
    """The model, or that of the ``with`` block; a `ModelError` if it is something else."""
    if not isinstance(model, pm.Model | None):
        is_number = isinstance(model, int | np.integer)
        advice = f" {model}: give a number by name, such as n_steps={model}" if is_number else ""
        raise ModelError(f"model must be a pymc.Model, got {type(model).__name__}{advice}")
    found = pm.Model.get_context(error_if_none=False) if model is None else model
    if found is None:
        raise ModelError(
            "model must be given outside a `with` block of a model, as model=m, got None"
        )
    return found


def state_space_nodes(model: pm.Model) -> dict[str, Any]:
    """The Apply node of every StateSpace variable, by name; its last five inputs are parameters."""
    return {
        rv.name: rv.owner
        for rv in model.basic_RVs
        if rv.owner is not None and isinstance(rv.owner.op, StateSpaceRV)
    }


def parameter_graphs(node: Any) -> dict[str, Variable]:
    """The graph of each parameter of a StateSpace variable; empty where theta is made otherwise."""
    theta, parameters = node.inputs[-5], node.op.system.parameters
    while theta.owner is not None and isinstance(theta.owner.op, SpecifyShape):
        theta = theta.owner.inputs[0]
    is_joined = theta.owner is not None and isinstance(theta.owner.op, Join)
    parts = theta.owner.inputs if is_joined else [theta]
    return dict(zip(parameters, parts, strict=True)) if len(parts) == len(parameters) else {}


def observes_state_space(model: pm.Model) -> bool:
    """Whether a model has an observed StateSpace variable."""
    nodes = state_space_nodes(model).values()
    return any(node.outputs[1] in model.observed_RVs for node in nodes)


def check_observed(model: pm.Model) -> None:
    """Raise unless StateSpace variables have data, their own or those of another variable.

    Without, their values are drawn as well.
    """
    seen = set(ancestors([*model.observed_RVs, *model.potentials]))
    for name, node in state_space_nodes(model).items():
        if node.outputs[1] in model.free_RVs and node.outputs[1] not in seen:
            raise ModelError(
                f"{name!r} has no data, so that its values would be sampled like parameters: give "
                f"it observed=..., use pm.observe(model, {{{name!r}: data}}), or draw it with "
                "pm.sample_prior_predictive"
            )


def have_missing_codes(model: pm.Model) -> bool:
    """Whether data of a model have a number that may stand for a missing value."""
    observed = [model.rvs_to_values[node.outputs[1]] for node in state_space_nodes(model).values()]
    known = [value.get_value() for value in observed if isinstance(value, SharedVariable)]
    known += [value.data for value in observed if isinstance(value, Constant)]
    return any(map(has_missing_codes, known))


def panel_variables(model: pm.Model) -> list[str]:
    """The names of the StateSpace variables that hold several records."""
    nodes = state_space_nodes(model)
    return [name for name, node in nodes.items() if isinstance(node.op, PanelRV)]


def scored_rows(node: Any) -> Any:
    """An index of the rows of an observed variable that have a term in the log-density."""
    score_from = getattr(node.op, "score_from", 0)
    if not score_from:
        return ...
    if not isinstance(node.op, PanelRV):
        return slice(score_from, None)
    codes = node.inputs[-4].eval(mode="FAST_COMPILE")[:, RECORD]
    # A row counts if the row so many rows before it belongs to the same record.
    before = np.zeros(min(score_from, codes.size), dtype=bool)
    return np.concatenate([before, codes[score_from:] == codes[:-score_from]])


def likelihood_nodes(graphs: Sequence[Variable]) -> list[Any]:
    """The Apply nodes of all likelihood operations in the graphs, each once."""
    nodes = {v.owner: None for v in ancestors(graphs) if v.owner is not None}
    return [node for node in nodes if isinstance(node.op, LogLikelihood)]


# The terms of each model, and what they were derived from.
_terms: WeakKeyDictionary[pm.Model, tuple[list[Any], list[TensorVariable]]] = WeakKeyDictionary()


def log_density_terms(model: pm.Model) -> list[tuple[str, TensorVariable]]:
    """The terms of a model's log-density, each with the name of its variable.

    They are derived once: a run asks for them seven times, a third of its time if the model is
    small.
    """
    variables = [*model.basic_RVs, *model.potentials]
    made_of = [*variables, *model.rvs_to_values.values(), *model.rvs_to_transforms.values()]
    known = _terms.get(model)
    if known is None or known[0] != made_of:
        known = _terms[model] = made_of, model.logp(sum=False)
    return [(v.name, term) for v, term in zip(variables, known[1], strict=True)]


def log_density_graph(
    model: pm.Model, variables: Sequence[TensorVariable] | None = None
) -> TensorVariable:
    """The graph of ``model.logp(variables)``, by default of all, of terms that are derived once."""
    terms = dict(log_density_terms(model))
    names = terms if variables is None else [variable.name for variable in variables]
    each = [pt.as_tensor(terms[name], allow_xtensor_conversion=True) for name in names]
    return variadic_add(*(term.sum() for term in each))


def noise_seeds(model: pm.Model) -> dict[str, SharedVariable]:
    """The shared noise seed of every variable whose likelihood is a random estimate."""
    seeds = {}
    for name, node in state_space_nodes(model).items():
        if not node.op.filter.noisy:
            continue
        seed = node.inputs[-1]
        if not isinstance(seed, SharedVariable):
            raise ModelError(
                f"the noise seed of {name!r} must be shared data, got a constant: use the model as "
                f"it was before freeze_dims_and_data"
            )
        seeds[name] = seed
    return seeds


def noisy_filters(model: pm.Model) -> dict[str, Filter]:
    """The filter of every variable whose likelihood is a random estimate."""
    filters = {name: node.op.filter for name, node in state_space_nodes(model).items()}
    return {name: filter for name, filter in filters.items() if filter.noisy}


def filters_used(model: pm.Model) -> dict[str, str]:
    """The attribute ``filter`` of results: a JSON text of the filter of every variable.

    Files of netCDF and Zarr store no mappings as attributes. Empty without such a variable.
    """
    nodes = state_space_nodes(model)
    used = {name: short_form(node.op.filter) for name, node in nodes.items()}
    return {"filter": json.dumps(used)} if used else {}


def is_filter(value: object) -> bool:
    """Whether a value is the settings of a filter."""
    return isinstance(value, Filter) and not isinstance(value, type)


def resized(filter: Any, n_members: int) -> Filter:
    """The same noisy filter with another number of members, the first of its settings."""
    count: dict[str, Any] = {fields(filter)[0].name: n_members}
    return replace(filter, **count)


def health_outputs(graphs: Sequence[Variable]) -> list[TensorVariable]:
    """The health vector of every filter evaluation in the graphs: see `ops.LogLikelihood`."""
    return [node.outputs[1] for node in likelihood_nodes(graphs)]


def gradient_obstacle(model: pm.Model) -> str:
    """Why a model has no gradient; empty if its filters have one."""
    for name, node in state_space_nodes(model).items():
        if node.op.filter.noisy:
            return f"the likelihood of {name!r} is estimated with noise"
        if not node.op.filter.has_gradient:
            return f"the likelihood of {name!r} has no gradient"
    return ""


def kinked_variable(model: pm.Model) -> str | None:
    """The StateSpace variable whose likelihood has kinks or jumps, or may have."""
    nodes = state_space_nodes(model).items()
    return next((name for name, node in nodes if not _is_smooth(node.op)), None)


def _is_smooth(op: Any) -> bool:
    system, of_filter = compile_system(op.system), getattr(op.filter, "is_smooth_for", None)
    return system.is_smooth if of_filter is None else of_filter(system)


def exactness(model: pm.Model) -> bool:
    """Whether sampling targets the model's posterior exactly, without the bias of a filter."""
    ops = [node.op for node in state_space_nodes(model).values()]
    return all(op.filter.is_exact_for(compile_system(op.system)) for op in ops)
