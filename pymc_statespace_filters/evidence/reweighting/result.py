"""The DataTree of a reweighted posterior."""

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ...importance import normalised, smoothed, systematic
from ...pymc_model.density import ConstrainedValues
from ..exact_density import ExactDensity
from .correction import Correction

POINTS = "weighted_posterior"  # the group of draws and defensive points with their weights
COPIED = ("observed_data", "constant_data")

Array = NDArray[np.float64]


def reweighted_tree(
    idata: xr.DataTree,
    draws: xr.Dataset,
    correction: Correction,
    density: ExactDensity,
    rng: np.random.Generator,
) -> xr.DataTree:
    """Resampled draws of the exact posterior, with the weighted points that they come from.

    ``draws`` is the posterior group of ``idata`` with the draws that have been weighted.
    """
    points = _points(draws, correction, density.model)
    log_weights, _ = smoothed(correction.pooled.log_weights)
    weights = normalised(log_weights)
    index = _resampled(weights, correction.pooled.shape, rng)
    chains, length = correction.pooled.shape
    coords = {"chain": np.arange(chains), "draw": np.arange(length)}
    posterior = _at(points, index).assign_coords(coords)
    stats = _sample_stats(correction, density, index, rng).assign_coords(coords)
    weighted = points.assign(
        weight=("sample", weights),
        log_weight=("sample", correction.pooled.log_weights),
        is_draw=("sample", np.arange(len(weights)) < chains * length),
    )
    groups = {"posterior": posterior, "sample_stats": stats, POINTS: weighted}
    groups |= {name: idata[name].to_dataset() for name in COPIED if name in idata.children}
    return xr.DataTree.from_dict(groups)


def _points(draws: xr.Dataset, correction: Correction, model: pm.Model) -> xr.Dataset:
    """The model's variables at all points, along the dimension ``sample``."""
    evaluate = ConstrainedValues(model, [*model.free_RVs, *model.deterministics])
    values = [evaluate(x) for x in correction.x[correction.pooled.n_draws :]]
    found = {}
    for name in evaluate.names:
        if name not in draws:
            continue
        array = draws[name].transpose("chain", "draw", ...)
        at_draws = array.values.reshape(-1, *array.shape[2:])
        at_points = np.stack([one[name] for one in values])
        found[name] = ("sample", *array.dims[2:]), np.concatenate([at_draws, at_points])
    kept = {dim for dims, _ in found.values() for dim in dims}
    coords = {name: one for name, one in draws.coords.items() if set(one.dims) <= kept}
    return xr.Dataset(found, coords=coords)


def _resampled(
    weights: Array, shape: tuple[int, int], rng: np.random.Generator
) -> NDArray[np.int64]:
    """Indices (chain, draw) of points, each as often as its weight says.

    Copies of a point are neighbours, and draws keep their order, with the defensive points spread
    evenly among them: the autocorrelation that ArviZ finds counts the copies as well as the chain's
    own.
    """
    n = shape[0] * shape[1]
    m = len(weights) - n
    place = np.concatenate([np.arange(n), (np.arange(m) + 0.5) * n / m - 0.5])
    order = np.argsort(place, kind="stable")
    return order[systematic(weights[order], n, rng)].reshape(shape)


def _at(points: xr.Dataset, index: NDArray[np.int64]) -> xr.Dataset:
    return points.isel(sample=xr.DataArray(index, dims=("chain", "draw")))


def _sample_stats(
    correction: Correction,
    density: ExactDensity,
    index: NDArray[np.int64],
    rng: np.random.Generator,
) -> xr.Dataset:
    """The log-density of every draw and the seeds behind it, as of a chain with the exact filter.

    Of several estimates of a point one is chosen with the probability that is its share of their
    sum: the point and its seed then have their joint posterior.
    """
    logs = correction.log_estimates[index]
    chosen = (logs + rng.gumbel(size=logs.shape)).argmax(axis=-1)[..., None]
    stats = {"lp": np.take_along_axis(logs, chosen, axis=-1)[..., 0]}
    seeds = np.take_along_axis(correction.seeds[index], chosen[..., None], axis=-2)[..., 0, :]
    for name, column in zip(density.names, np.moveaxis(seeds, -1, 0), strict=False):
        stats[f"{name}_seed"] = column
    return xr.Dataset({name: (("chain", "draw"), value) for name, value in stats.items()})
