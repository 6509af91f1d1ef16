"""Probabilities of terms under wider or narrower slabs, from the same points.

A slab p scaled by the factor w about the value a where the term vanishes is
p_w(c) = p(a + (c - a) / w) / w. The weights of the points of each sub-model are multiplied by
p_w / p, without new likelihoods. With wider slabs nearly all of the prior is at values that the
data exclude, so that every term loses its probability in the end (Lindley's paradox).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pymc.distributions.transforms import _default_transform
from pymc.logprob.transforms import LogTransform
from pytensor.graph.traversal import ancestors
from scipy.stats import norm

from ..evidence.comparison.width_curves import dataset_of_curves
from .doubts import unreliable
from .probabilities import Probabilities
from .submodel_density import Array, SubmodelDensity
from .submodel_evidence import Weighted

MAX_SHARE = 0.05  # of the probability, in sub-models whose points do not know it
CI_PROB = 0.95


def inclusion_by_width(
    found: Probabilities,
    points: Sequence[Weighted],
    density: SubmodelDensity,
    widths: Array,
) -> xr.Dataset:
    """The probabilities of inclusion for slabs that are all scaled by a factor.

    The result is as that of `prior_sensitivity`, with the terms in place of models. NaN where the
    points do not determine it.
    """
    scale = _scale_of_columns(density)
    size = np.array([(scale[density.columns_of(one)] != "").sum() for one in found.present])
    known = [one for one in points if len(one.x)]
    probability, error = np.full((2, len(density.candidates), len(widths)), np.nan)
    for j, width in enumerate(widths):
        ratios = iter(_log_ratios(known, density, scale, float(width)))
        scaled = [
            replace(one, log_weights=one.log_weights + next(ratios)) if len(one.x) else one
            for one in points
        ]
        at_width, beyond = _with_bounds(found, scaled, np.maximum(-size * np.log(width), 0.0))
        unknown = beyond.sum() + at_width.of_models[unreliable(at_width, scaled)].sum()
        if unknown <= MAX_SHARE:
            probability[:, j], error[:, j] = at_width.inclusion, at_width.inclusion_se
    return _curves(density, probability, error, widths, scale)


def _scale_of_columns(density: SubmodelDensity) -> NDArray[np.str_]:
    """How a column is scaled, (k,): "linear", "log" or, if not at all, "".

    A prior that depends on another candidate is not, as that one is scaled at the same points.
    """
    model, kinds = density.model, np.full(len(density.blocks), "", dtype="<U6")
    candidates = {model[name] for name in density.candidates.variables}
    held = density.candidates.switches.held_at(len(kinds))
    for column in np.concatenate(density.candidates.switches.columns):
        rv = density.variables[column]
        if candidates & set(ancestors([rv])) - {rv}:
            continue
        transform, natural = model.rvs_to_transforms[rv], _default_transform(rv.owner.op, rv)
        is_positive = isinstance(natural, LogTransform)
        if isinstance(transform, LogTransform) and held[column] == 0:
            kinds[column] = "log"
        elif transform is None and (natural is None or (is_positive and held[column] == 0)):
            kinds[column] = "linear"
    return kinds


def _log_ratios(
    points: Sequence[Weighted], density: SubmodelDensity, scale: NDArray[np.str_], width: float
) -> list[Array]:
    """The logs of p_w / p at the points of sub-models."""
    x = np.concatenate([one.x for one in points])
    counts = [len(one.x) for one in points]
    present = np.repeat([one.proposal.present for one in points], counts, axis=0)
    held = density.candidates.switches.held_at(x.shape[1])
    moved = np.where(scale == "linear", held + (x - held) / width, x)
    moved = np.where(scale == "log", x - np.log(width), moved)
    columns = np.flatnonzero(scale != "")
    blocks = density.blocks[columns]
    before, after = (density.priors.in_parts(at, present).own[:, blocks] for at in (x, moved))
    # Points outside the support of a slab have no weight, whatever its width.
    before = np.where(np.isneginf(before), 0.0, before)
    # The logarithm of a quantity has the factor 1 / w in its Jacobian already.
    ratio = after - before - np.log(width) * (scale[columns] == "linear")
    is_there = present[:, density.candidate_of[columns]]
    return np.split(np.where(is_there, ratio, 0.0).sum(axis=1), np.cumsum(counts)[:-1])


def _with_bounds(
    found: Probabilities, points: Sequence[Weighted], more: Array
) -> tuple[Probabilities, Array]:
    """Probabilities for new weights, and the shares of sub-models without points at most.

    The evidence of these rises at most by ``more`` (S,), the ratio of the slabs where the terms
    vanish.
    """
    has_points = np.array([len(one.x) > 0 for one in points])
    means = [one.mean for one in points]
    value = np.array([one.value for one in means]) + np.where(has_points, 0.0, more)
    scaled = replace(found, log_evidence=value, error=np.array([one.error for one in means]))
    return scaled, scaled.of_models * ~has_points


def _curves(
    density: SubmodelDensity,
    probability: Array,
    error: Array,
    widths: Array,
    scale: NDArray[np.str_],
) -> xr.Dataset:
    margin = norm.ppf((1 + CI_PROB) / 2) * error
    fields = {
        "prob": probability,
        "prob_low": np.maximum(probability - margin, 0.0),
        "prob_high": np.minimum(probability + margin, 1.0),
        "se": error,
    }
    candidates = density.candidates
    columns = np.concatenate(candidates.switches.columns)
    left_out = [candidates.elements.labels[i] for i in columns if scale[i] == ""]
    return dataset_of_curves(
        fields,
        candidates.labels,
        widths,
        ci_prob=CI_PROB,
        left_out=", ".join(left_out),
        width_of="term",
    )
