"""The DataTree of `select_terms`, with draws of all sub-models, by weight and probability."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..evidence.comparison.width_curves import width_factors
from ..pymc_model.inspection import exactness, filters_used
from ..pymc_model.posterior_draws import AVERAGED
from ..statistics.importance import normalised, systematic
from .candidates import Candidates
from .inclusion import Restriction
from .probabilities import Probabilities
from .submodel_density import Array, Seeds, Sets, SubmodelDensity
from .submodel_evidence import LEAST_EFFECTIVE, Visits, Weighted
from .widths import inclusion_by_width

LEAST_SHOWN = 1e-4  # probability of a sub-model whose weights are looked at
COPIED = ("observed_data", "constant_data")


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


def as_datatree(
    found: Probabilities,
    points: Sequence[Weighted],
    prior: Restriction,
    visits: Visits | None,
    drawn: Averaged,
    density: SubmodelDensity,
    idata: xr.DataTree,
) -> xr.DataTree:
    """The result; sub-models are ordered by probability.

    ``visits`` are those of chains, if not all sub-models were estimated.
    """
    order = np.argsort(-found.of_models, kind="stable")
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order))
    like = idata["posterior"].to_dataset()
    groups = {
        "terms": _terms(found, prior, visits, density.candidates),
        "models": _models(found, points, prior, density.candidates, order),
        "widths": inclusion_by_width(found, points, density, width_factors(None)),
        "posterior": _posterior(drawn, found.present, density, like),
        "sample_stats": _stats(drawn, number, density, like),
    }
    groups |= {name: idata[name].to_dataset() for name in COPIED if name in idata.children}
    tree = xr.DataTree.from_dict(groups)
    facts = {"exact": int(exactness(density.model)), "sampler": AVERAGED}
    tree.attrs |= filters_used(density.model) | facts
    return tree


def _posterior(
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


def _terms(
    found: Probabilities, prior: Restriction, visits: Visits | None, candidates: Candidates
) -> xr.Dataset:
    labels = candidates.labels
    of_visits = {}
    if visits is not None:
        of_visits = {"visits": ("term", visits.frequency), "visits_se": ("term", visits.error)}
    return xr.Dataset(
        {
            "inclusion": ("term", found.inclusion),
            "inclusion_se": ("term", found.inclusion_se),
            "prior_inclusion": ("term", prior.inclusion),
            "median_model": ("term", found.inclusion > 0.5),
            "pairs": (("term", "term_other"), found.pairs),
        }
        | of_visits,
        coords={"term": labels, "term_other": labels},
    )


def _models(
    found: Probabilities,
    points: Sequence[Weighted],
    prior: Restriction,
    candidates: Candidates,
    order: np.ndarray,
) -> xr.Dataset:
    n_effective = np.array([one.n_effective for one in points])
    # Of a few points far from all that matters not even the order of an error is known.
    excluded = (found.of_models <= LEAST_SHOWN) & (n_effective < LEAST_EFFECTIVE)
    by_model = {
        "probability": found.of_models,
        "probability_se": found.of_models_se,
        "log_evidence": found.log_evidence,
        "se": np.where(excluded, np.nan, found.error),
        "prior": np.exp(found.log_prior) / prior.share,
        "n_evaluations": np.array([one.count for one in points]),
        "n_effective": n_effective,
        "pareto_k": np.array([_tail(*each) for each in zip(points, found.of_models, strict=True)]),
    }
    present: Sets = found.present[order]
    return xr.Dataset(
        {"present": (("model", "term"), present)}
        | {name: ("model", values[order]) for name, values in by_model.items()},
        coords={"model": np.arange(len(order)), "term": candidates.labels},
    )


def _tail(one: Weighted, probability: float) -> float:
    """The tail of the weights, unless the sub-model is far too improbable to matter."""
    return one.pareto_k if probability > LEAST_SHOWN else np.nan


def _stats(
    drawn: Averaged, number: np.ndarray, density: SubmodelDensity, like: xr.Dataset
) -> xr.Dataset:
    shape = like.sizes["chain"], like.sizes["draw"]
    columns = {"model": number[drawn.model]}
    columns |= {
        f"{name}_seed": seeds
        for name, seeds in zip(density.density.seed_names, drawn.seeds.T, strict=True)
    }
    return xr.Dataset(
        {name: (("chain", "draw"), values.reshape(shape)) for name, values in columns.items()},
        coords={dim: like[dim] for dim in ("chain", "draw")},
    )
