"""The DataTree of a reweighted posterior."""

import numpy as np
import pymc as pm
import xarray as xr

from ...pymc_model.at_points import ConstrainedValues
from ..exact_density import ExactDensity
from .correction import Correction

POINTS = "weighted_posterior"  # the group of draws and defensive points with their weights
COPIED = ("observed_data", "constant_data")


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
    index, chosen = correction.resampled(rng)
    coords = {"chain": np.arange(index.shape[0]), "draw": np.arange(index.shape[1])}
    at = xr.DataArray(index, coords, dims=("chain", "draw"))
    stats = {"lp": correction.log_estimates[index, chosen]}
    seeds = np.moveaxis(correction.seeds[index, chosen], -1, 0)
    stats |= {f"{name}_seed": one for name, one in zip(density.names, seeds, strict=False)}
    weighted = points.assign(
        weight=("sample", correction.weights),
        log_weight=("sample", correction.pooled.log_weights),
        is_draw=("sample", np.arange(len(correction.x)) < index.size),
    )
    groups = {
        "posterior": points.isel(sample=at),
        "sample_stats": at.to_dataset(name="point").assign(
            {name: (("chain", "draw"), values) for name, values in stats.items()}
        ),
        POINTS: weighted,
    }
    groups |= {name: idata[name].to_dataset() for name in COPIED if name in idata.children}
    return xr.DataTree.from_dict(groups)


def _points(draws: xr.Dataset, correction: Correction, model: pm.Model) -> xr.Dataset:
    """The model's variables at all points, along the dimension ``sample``."""
    evaluate = ConstrainedValues(model, [*model.free_RVs, *model.deterministics])
    values = evaluate(correction.x[correction.pooled.n_draws :])
    found = {}
    for name in evaluate.names:
        if name not in draws:
            continue
        array = draws[name].transpose("chain", "draw", ...)
        at_draws = array.values.reshape(-1, *array.shape[2:])
        found[name] = ("sample", *array.dims[2:]), np.concatenate([at_draws, values[name]])
    kept = {dim for dims, _ in found.values() for dim in dims}
    coords = {name: one for name, one in draws.coords.items() if set(one.dims) <= kept}
    return xr.Dataset(found, coords=coords)
