"""Whether draws are those of a model, for all that is computed at draws."""

import json
from contextlib import suppress

import numpy as np
import pymc as pm
import xarray as xr

from ..compiler.lowering.compiled_system import compile_system
from ..compiler.native.compilation import COMPILATION
from ..errors import DataMismatchError, ModelError
from ..filters.written import filter_from, short_form
from .density import ModelDensity
from .fingerprint import model_data_fingerprint, model_fingerprint
from .inspection import state_space_nodes
from .other_filter import model_of_draws, model_with_filters
from .posterior_draws import (
    AVERAGED,
    STATES,
    noise_was_moved,
    not_missing,
    posterior_group,
    unconstrained_draws,
)
from .stored_density import (
    compared,
    has_seeds_of_records,
    is_of_all_variables,
    lacking_seeds,
    stats_of,
    stored_name,
    stored_seeds,
)

_REMEDY = "pass the model that was sampled"


def checked_model(
    model: pm.Model | None,
    idata: xr.DataTree,
    *,
    any_filter: bool = False,
    new_data: bool | None = None,
) -> pm.Model:
    """The model of `model_of_draws`, if the draws can be those of its posterior.

    What was stored with the draws is compared: the data, the filters, and the log-density of some
    draws. With ``any_filter`` the filter of the model is not used. ``new_data`` is whether other
    data are meant, so that nothing is compared; None where they never are. Raises
    `DataMismatchError` if the draws are those of another model.
    """
    model = model_of_draws(model, idata)
    if new_data or not isinstance(idata, xr.DataTree) or idata.attrs.get("sampler") == AVERAGED:
        return model
    if "posterior" not in idata.children or _is_same_run(idata, model):
        return model
    remedy = _REMEDY if new_data is None else f"{_REMEDY}, or new_data=True if other data are meant"
    _check_data(idata, model, remedy)
    with suppress(ModelError):  # what cannot be compared is taken as it is
        _check_density(idata, _with_filters_of(idata, model, any_filter), remedy)
    return model


def _is_same_run(idata: xr.DataTree, model: pm.Model) -> bool:
    """Whether chains of this model, with these data, have stored where they go on."""
    if STATES not in idata.children:
        return False
    stored = idata[STATES].attrs
    try:
        found = model_fingerprint(model), model_data_fingerprint(model)
    except ModelError:  # of a model that no text identifies
        return False
    return found == (stored.get("model"), stored.get("data"))


def _check_data(idata: xr.DataTree, model: pm.Model, remedy: str) -> None:
    """Raise if a StateSpace variable has other rows than it had; missing ones may be left out."""
    known = idata["observed_data"].to_dataset() if "observed_data" in idata.children else {}
    for name, node in state_space_nodes(model).items():
        if name not in known or node.outputs[1] not in model.observed_RVs:
            continue
        own = not_missing(model.rvs_to_values[node.outputs[1]].eval(mode="FAST_COMPILE"))
        seen = not_missing(known[name].values)
        if own.shape != seen.shape or not np.allclose(own, seen, 1e-6, 0.0, equal_nan=True):
            raise DataMismatchError(
                f"the observations of {name!r} must be those of the draws, in "
                f"idata['observed_data'], got others: {remedy}"
            )


def _with_filters_of(idata: xr.DataTree, model: pm.Model, any_filter: bool) -> pm.Model:
    """The model with the filters of the run, whose posterior must be that by its own filters."""
    nodes, former = state_space_nodes(model), {}
    for name, text in json.loads(idata.attrs.get("filter", "{}")).items():
        if name not in nodes or text == short_form(nodes[name].op.filter):
            continue
        own, system = nodes[name].op.filter, compile_system(nodes[name].op.system)
        if (filter := filter_from(text)) is None:
            raise ModelError(f"{text} is a filter of a user's own class")
        if not any_filter and not (filter.is_exact_for(system) and own.is_exact_for(system)):
            raise DataMismatchError(
                f"the draws are those of a posterior by {text} of {name!r}, and the model has "
                f"{short_form(own)}, with another posterior: {_REMEDY}, and {short_form(own)} as "
                "filter= for results by it"
            )
        former[name] = filter
    return model_with_filters(model, former) if former else model


def _check_density(idata: xr.DataTree, model: pm.Model, remedy: str) -> None:
    """Raise a `DataMismatchError` if stored log-densities are not those of the model.

    A `ModelError` if the draws are not of all variables, or not of continuous ones.
    """
    posterior = posterior_group(idata)
    labels = {dim: posterior[dim].values for dim in ("chain", "draw")}
    stats = stats_of(idata)
    if not all(dim in stats.dims and np.isin(at, stats[dim]).all() for dim, at in labels.items()):
        return
    stats = stats.sel(labels)
    name = stored_name(stats)
    if name is None or noise_was_moved(idata) or not is_of_all_variables(stats):
        return
    try:
        draws = unconstrained_draws(idata, model, least=1)
    except DataMismatchError:  # they may be of those variables that are needed
        return
    with COMPILATION:
        density = ModelDensity(model)
    if not lacking_seeds(stats, density) and not has_seeds_of_records(stats, density):
        with np.errstate(invalid="ignore"):  # what is no seed is refused where it is used
            seeds = stored_seeds(stats, density, draws.shape[:2])
        compared(stats, name, density, draws, seeds, f": {remedy}")
