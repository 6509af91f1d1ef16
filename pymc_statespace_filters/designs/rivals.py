"""Rival models as designs see them: one system, its filter, and independent draws of theta."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray
from pytensor.graph.traversal import ancestors

from ..errors import DataMismatchError, ModelError
from ..filters.protocol import Filter
from ..filters.written import short_form
from ..pymc_model.at_points import GraphsAtPoints
from ..pymc_model.checked_model import checked_model
from ..pymc_model.density import check_free_variables
from ..pymc_model.elements import places_in_vector
from ..pymc_model.inspection import exactness, state_space_nodes
from ..pymc_model.posterior_draws import unconstrained_draws
from ..pymc_model.prior import ModelPrior
from ..pymc_model.random_variable import PanelRV
from ..system.model import StateSpaceModel
from .dummy_data import with_dummy_data

FEWEST = 20  # draws and records, of which a jackknife makes groups
ALONE = "model"  # the name of a model that is given without one

Array = NDArray[np.float64]


class Rival(NamedTuple):
    """A model: theta (n, k) at draws of the prior, or at some of those that are given.

    Of the latter there are ``n_given``, worth ``n_effective`` independent ones; else both are n.

    ``mixed`` (j) is theta (n, k) where the variables asked about have the values of draw j, and the
    others those of all draws; None where all are asked about.
    """

    system: StateSpaceModel
    filter: Filter
    theta: Array
    n_given: int
    n_effective: int
    is_exact: bool
    mixed: Callable[[int], Array] | None


def named_models(models: Any) -> dict[str, pm.Model]:
    """The models by name."""
    found = dict(models) if isinstance(models, Mapping) else {ALONE: models}
    if not found or not all(isinstance(one, pm.Model) for one in found.values()):
        got = list(found.values()) or models
        raise ModelError(f"models must be a pymc.Model, or a dict of them by name, got {got!r}")
    for name in found:
        if not isinstance(name, str) or not name:
            raise ModelError(f"names of models must be non-empty strings, got {name!r}")
    return found


def read_rivals(
    models: Mapping[str, pm.Model],
    idata: Any,
    n_draws: int,
    rng: np.random.Generator,
    var_names: Sequence[str] | None = None,
) -> dict[str, Rival]:
    """The models with draws of their priors, or of ``idata``, a DataTree or one for each model.

    Raises `ModelError` if a model has no repeatable likelihood of one record, or too few draws;
    `DataMismatchError` if draws are those of another model.
    """
    if idata is not None and not isinstance(idata, Mapping | xr.DataTree):
        raise ModelError(f"idata must be a DataTree, or a dict of them by model, got {idata!r}")
    if isinstance(idata, xr.DataTree) and len(models) == 1:
        idata = dict.fromkeys(models, idata)
    if idata is not None and (isinstance(idata, xr.DataTree) or set(idata) != set(models)):
        got = "one DataTree" if isinstance(idata, xr.DataTree) else list(idata)
        raise ModelError(f"idata must have draws of each of the models {list(models)}, got {got}")
    found = {}
    for name, model in models.items():
        own = None if idata is None else idata[name]
        try:
            found[name] = _read(model, own, n_draws, rng, var_names)
        except (ModelError, DataMismatchError) as error:
            place = "models" if list(models) == [ALONE] else f"models[{name!r}]"
            raise type(error)(f"{place}: {error}") from None
    names = {name: one.system.observables for name, one in found.items()}
    if len(set(names.values())) > 1:
        raise ModelError(f"models must have the same observables in the same order, got {names}")
    return found


def _read(
    model: pm.Model,
    idata: Any,
    n_draws: int,
    rng: np.random.Generator,
    var_names: Sequence[str] | None,
) -> Rival:
    nodes = state_space_nodes(model)
    if len(nodes) != 1:
        raise ModelError(f"a design needs a model with one StateSpace variable, got {list(nodes)}")
    ((name, node),) = nodes.items()
    system, filter = node.op.system, node.op.filter
    if isinstance(node.op, PanelRV):
        raise ModelError(
            f"{name!r} must hold one record, got a panel: build the model of the new record alone, "
            "with the parameters of the records as a prior"
        )
    if filter.noisy:
        raise ModelError(
            f"the filter of {name!r} must have the same likelihood at each call, got "
            f"{short_form(filter)}, whose noise would count as information: use another one, such "
            "as EKF, UKF, IPLF or GridFilter"
        )
    if node.op.score_from:
        raise ModelError(
            f"score_from of {name!r} must be 0, as a new record begins at the start, got "
            f"{node.op.score_from}"
        )
    model, is_exact = with_dummy_data(model), exactness(model)
    if idata is not None:
        model = checked_model(model, idata, any_filter=True)
    x, n_given, n_effective = _draws(model, idata, n_draws, rng)
    columns = None if var_names is None else _columns(model, idata, var_names)
    graph = state_space_nodes(model)[name].inputs[-5]
    if not model.free_RVs:
        theta = np.tile(graph.eval(mode="FAST_COMPILE"), (n_draws, 1))
        return Rival(system, filter, theta, n_given, n_effective, is_exact, None)
    graphs = GraphsAtPoints(model, [graph])

    def theta_at(points: Array) -> Array:
        return np.ascontiguousarray(graphs(points)[0])

    def mixed(j: int) -> Array:
        points = x.copy()
        points[:, columns] = x[j, columns]
        return theta_at(points)

    own = None if columns is None else mixed
    return Rival(system, filter, theta_at(x), n_given, n_effective, is_exact, own)


def _draws(
    model: pm.Model, idata: Any, n_draws: int, rng: np.random.Generator
) -> tuple[Array, int, int]:
    """Independent draws (n, k), how many there were, and how many independent ones they are."""
    if not model.free_RVs:
        return np.zeros((n_draws, 0)), n_draws, n_draws
    check_free_variables(model)
    if idata is not None:
        return _independent(unconstrained_draws(idata, model), n_draws, rng)
    nodes = state_space_nodes(model)
    left_out = [rv.name for rv in (*model.observed_RVs, *model.potentials) if rv.name not in nodes]
    if left_out:
        raise ModelError(
            f"draws of the prior know nothing of {left_out}, data or potentials of the model: give "
            "draws of its posterior as idata="
        )
    return ModelPrior(model).sample(n_draws, rng), n_draws, n_draws


def _columns(model: pm.Model, idata: Any, var_names: Sequence[str]) -> NDArray[np.int64]:
    """The columns of some variables, which must be independent of the others."""
    names = [rv.name for rv in model.free_RVs]
    is_list = isinstance(var_names, list | tuple) and var_names
    if not is_list or any(name not in names for name in var_names):
        raise ModelError(f"var_names must be a list of some of {names}, got {var_names!r}")
    if idata is not None:
        raise ModelError("var_names must be None with idata, whose draws are dependent")
    chosen = [rv for rv in model.free_RVs if rv.name in var_names]
    above = set(ancestors(chosen))
    others = [rv for rv in model.free_RVs if rv not in chosen]
    if joint := [rv.name for rv in others if rv in above or {*ancestors([rv])} & {*chosen}]:
        raise ModelError(
            f"var_names must be independent of the other variables in the prior, got "
            f"{list(var_names)} beside {joint}: name those, too"
        )
    places = places_in_vector(model)
    return np.concatenate([places[rv.name].ravel() for rv in chosen])


def _independent(draws: Array, n_draws: int, rng: np.random.Generator) -> tuple[Array, int, int]:
    """Draws (chain, draw, k), evenly thinned to no more than their effective number, shuffled."""
    from arviz_stats.base import array_stats  # loads much: see `statistics.importance`

    sizes = [
        array_stats.ess(one, chain_axis=0, draw_axis=1, method="bulk")
        for one in np.moveaxis(draws, -1, 0)
    ]
    below = np.concatenate(draws)
    n_effective = int(min(np.min(sizes), len(below)))
    if n_effective < FEWEST:
        raise ModelError(
            f"idata must have at least {FEWEST} independent draws, got {len(below)} draws that are "
            f"worth {n_effective} (the smallest bulk effective sample size): sample longer"
        )
    chosen = np.linspace(0, len(below) - 1, min(n_draws, n_effective)).round().astype(int)
    return below[rng.permutation(chosen)], len(below), n_effective
