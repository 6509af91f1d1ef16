"""Draws averaged over sub-models: points of all of them, by weight and probability."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..statistics.importance import normalised, systematic
from .submodel_density import Array, Seeds, Sets, SubmodelDensity
from .submodel_evidence import Weighted


class Averaged(NamedTuple):
    """Equally likely draws (n,) of parameters and sub-models."""

    x: Array  # (n, k)
    model: NDArray[np.int64]  # (n,)
    seeds: Seeds  # (n, v)


def averaged(
    points: Sequence[Weighted], probability: Array, count: int, rng: np.random.Generator
) -> Averaged:
    """So many draws of all sub-models, in random order."""
    usable = [i for i, one in enumerate(points) if len(one.x) and probability[i] > 0]
    weights = np.concatenate([probability[i] * normalised(points[i].log_weights) for i in usable])
    model = np.repeat(usable, [points[i].count for i in usable])
    index = rng.permutation(systematic(weights, count, rng))
    x = np.concatenate([points[i].x for i in usable])
    seeds = np.concatenate([points[i].seeds for i in usable])
    return Averaged(x[index], model[index], seeds[index])


def posterior_of(
    drawn: Averaged, sets: Sets, density: SubmodelDensity, like: xr.Dataset
) -> xr.Dataset:
    """The draws as a posterior group of the shape of another, ``like``, with its variables.

    A term that a draw does not have is at the value at which it vanishes.
    """
    model = density.model
    names = [rv for rv in [*model.free_RVs, *model.deterministics] if rv.name in like]
    found = density.density.constrained(names)(drawn.x, sets[drawn.model])
    shape = like.sizes["chain"], like.sizes["draw"]
    variables = {}
    for name, values in found.items():
        array = like[name].transpose("chain", "draw", ...)
        variables[name] = array.dims, values.reshape(*shape, *array.shape[2:])
    kept = {dim for dims, _ in variables.values() for dim in dims}
    coords = {name: one for name, one in like.coords.items() if set(one.dims) <= kept}
    return xr.Dataset(variables, coords=coords)
