"""Posterior draws from a DataTree: checks of its contents, and the draws unconstrained.

The unconstrained space is that of the model's value variables: every free variable is transformed,
and vectors and matrices are flattened.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pymc as pm
import pytensor
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from pymc.initial_point import make_initial_point_fn
from pytensor.graph.replace import graph_replace
from pytensor.tensor.variable import TensorVariable

from ..compiler.native.rows import at_points
from ..errors import DataMismatchError, ModelError

MIN_DRAWS = 20
STATES = "sampler_state"  # the group of the last states of chains
# Attributes: what the end of a run says of integration steps, and by how many nats the evidence
# changes with steps half as long, if that was computed.
STEP_CHECK, STEP_NATS = "step_check", "step_nats"
# Values of the attribute ``sampler`` of draws.
BY_PARTICLES = "smc"  # their filter may not be that of the model
COURSE = "smc"  # group with the course of their run
AVERAGED = "select_terms"  # over sub-models
SEQUENTIAL = "sequential"  # of the attribute ``data`` of `BY_PARTICLES`, of a run that can go on


def posterior_group(idata: xr.DataTree) -> xr.Dataset:
    """The posterior group, checked to have the dimensions chain and draw."""
    if not isinstance(idata, xr.DataTree):
        raise ModelError(
            "idata must be a DataTree of posterior draws, as pm.sample and sample_dram return it, "
            f"got {type(idata).__name__}"
        )
    if "posterior" not in idata.children:
        raise ModelError(f"idata must have a group 'posterior', got {sorted(idata.children)}")
    posterior = idata["posterior"].to_dataset()
    if not {"chain", "draw"} <= set(posterior.dims):
        raise ModelError(
            "the posterior of idata must have the dimensions chain and draw, got "
            f"{sorted(map(str, posterior.dims))}: select one chain as isel(chain=[0])"
        )
    return posterior


def are_populations(idata: xr.DataTree | None) -> bool:
    """Whether the chains are the populations of `sample_smc`, of which R-hat says nothing.

    The draws of one have common ancestors, so that populations scatter more than chains with as
    many draws; their scatter is the error.
    """
    return idata is not None and idata.attrs.get("sampler") == BY_PARTICLES


def populations_of(idata: xr.DataTree) -> NDArray[np.int64] | None:
    """The population of each draw (chain, draw); None of draws of chains.

    Without the group that has it, it is the chain, which is nearly a population.
    """
    if not are_populations(idata):
        return None
    if "sample_stats" in idata.children and "population" in idata["sample_stats"]:
        return idata["sample_stats"]["population"].transpose("chain", "draw").values
    sizes = idata["posterior"].sizes
    return np.broadcast_to(np.arange(sizes["chain"])[:, None], (sizes["chain"], sizes["draw"]))


def check_one_model(idata: xr.DataTree, model: pm.Model) -> None:
    """Raise unless the draws can be those of the posterior of a model.

    Raises `ModelError` if they are averaged over sub-models, and so have no one density; else as
    `check_same_rows`.
    """
    if isinstance(idata, xr.DataTree) and idata.attrs.get("sampler") == AVERAGED:
        raise ModelError(
            "idata must have draws of one model, got those of select_terms, which are averaged over"
            " sub-models: the evidence of each of these is in idata['models']; for another result "
            "of the full model, draw from it by psf.sample"
        )
    check_same_rows(idata, model)


def check_same_rows(idata: xr.DataTree, model: pm.Model) -> None:
    """Raise a `DataMismatchError` if a sequential run has seen other observations than a model has.

    `extend` makes its record longer than that of the model which the user has at hand. Other draws
    may be used with other data. Missing rows may be NaN in one and left out in the other.
    """
    if idata.attrs.get("data") != SEQUENTIAL or "observed_data" not in idata.children:
        return
    record = idata["observed_data"].to_dataset()
    for rv in model.observed_RVs:
        if rv.name not in record:
            continue
        own = not_missing(model.rvs_to_values[rv].eval(mode="FAST_COMPILE"))
        seen = not_missing(record[rv.name].values)
        if np.array_equal(seen, own, equal_nan=True):
            continue
        remedy = "go on with the others by psf.extend"
        if len(own) <= len(seen):
            remedy = "build the model with all rows of idata['observed_data']"
        raise DataMismatchError(
            f"model must have the rows of {rv.name!r} in idata: the draws were made with "
            f"{len(seen)} rows that are not missing, and the model has "
            f"{len(own) if len(own) != len(seen) else 'other values in them'}: {remedy}"
        )


def not_missing(rows: ArrayLike) -> NDArray[np.float64]:
    """The rows (J, p) of a record that are not entirely missing."""
    values = np.asarray(rows, dtype=np.float64)
    return values[~np.isnan(values).all(axis=-1)]


def noise_was_moved(idata: xr.DataTree) -> bool:
    """Whether the chain moved the noise of its estimates, so that no seed reproduces them."""
    return "sample_stats" in idata.children and "correlation" in idata["sample_stats"]


def unconstrained_draws(
    idata: xr.DataTree,
    model: pm.Model,
    names: Sequence[str] | None = None,
    *,
    least: int = MIN_DRAWS,
) -> NDArray[np.float64]:
    """The posterior group, checked against the model, in unconstrained space (chain, draw, k).

    Of the free variables with these names; default: all. The others may be missing. Of each chain
    there must be at least so many draws.
    """
    posterior = posterior_group(idata)
    chosen = [rv for rv in model.free_RVs if names is None or rv.name in names]
    missing = [rv.name for rv in chosen if rv.name not in posterior]
    if missing:
        raise DataMismatchError(
            f"idata must have draws of {missing}, free variables of the model, got "
            f"{sorted(map(str, posterior.data_vars))}"
        )
    n_chains, n_draws = posterior.sizes["chain"], posterior.sizes["draw"]
    if n_draws < least:
        raise ModelError(f"idata must have at least {least} draws per chain, got {n_draws}")

    shapes = model.eval_rv_shapes()
    for rv in chosen:
        drawn = posterior[rv.name].transpose("chain", "draw", ...).shape[2:]
        expected = tuple(int(length) for length in shapes[rv.name])
        if drawn != expected:
            raise DataMismatchError(
                f"{rv.name!r} in idata must have the model's shape {expected}, got {drawn}"
            )
    completed = _completed(posterior, model).transpose("chain", "draw", ...)
    values = {rv.name: np.concatenate(completed[rv.name].values) for rv in model.free_RVs}
    draws = unconstrained(model, values, chosen).reshape(n_chains, n_draws, -1)
    outside = int((~np.isfinite(draws).all(axis=-1)).sum())
    if outside:
        raise DataMismatchError(
            "draws in idata must lie inside the support of the model's free variables, got "
            f"{outside} of {n_chains * n_draws} draws outside or on its boundary: idata belongs to "
            "another model"
        )
    return draws


def unconstrained(
    model: pm.Model,
    values: Mapping[str, np.ndarray],
    chosen: Sequence[TensorVariable] = (),
) -> NDArray[np.float64]:
    """Points (n, k) from values (n, ...) of all free variables; of some of them, if so ``chosen``.

    What lies outside the support is not finite.
    """
    return unconstraining(model)(values, chosen)


def unconstraining(model: pm.Model) -> Callable:
    """The function `unconstrained` of values and chosen variables of a model.

    PyMC's ``unconstrain_values`` hands DataArrays to operations that need arrays, such as that of
    `LKJCorr`.
    """
    free = list(model.free_RVs)
    symbols = [rv.type() for rv in free]
    graphs = []
    for rv, symbol in zip(free, symbols, strict=True):
        transform = model.rvs_to_transforms[rv]
        graphs.append(symbol if transform is None else transform.forward(symbol, *rv.owner.inputs))
    graphs = graph_replace(graphs, dict(zip(free, symbols, strict=True)), strict=False)
    batches, results = at_points(symbols, graphs)
    # Calls are too few to repay compilation to machine code.
    function = pytensor.function(batches, results, mode="FAST_COMPILE", on_unused_input="ignore")

    def at(
        values: Mapping[str, np.ndarray], chosen: Sequence[TensorVariable] = ()
    ) -> NDArray[np.float64]:
        arrays = [
            values[rv.name].astype(batch.type.dtype)
            for rv, batch in zip(free, batches, strict=True)
        ]
        found = dict(zip(free, function(*arrays), strict=True))
        columns = [found[rv].reshape(len(arrays[0]), -1) for rv in chosen or free]
        return np.concatenate(columns, axis=1).astype(np.float64)

    return at


def _completed(posterior: xr.Dataset, model: pm.Model) -> xr.Dataset:
    """The draws, with the model's initial value of each free variable that they lack."""
    missing = [rv.name for rv in model.free_RVs if rv.name not in posterior]
    if not missing:
        return posterior
    start = make_initial_point_fn(model=model, return_transformed=False)(0)
    sizes = posterior.sizes["chain"], posterior.sizes["draw"]
    filled = {}
    for name in missing:
        value = np.asarray(start[name])
        axes = [f"{name}_axis_{i}" for i in range(value.ndim)]
        filled[name] = ["chain", "draw", *axes], np.broadcast_to(value, sizes + value.shape)
    return posterior.assign(filled)
