"""Separate modes among the points of a search: where they are, and whether labels change places."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from pymc.model import Model

from ..checks.coverage import ALL_MODES
from ..pymc_model.at_points import ConstrainedValues
from ..pymc_model.density import ModelDensity
from ..pymc_model.inspection import noise_seeds
from ..sampling.output.facts import SeparateModes
from ..sampling.starts.modes import is_reordered
from ..sampling.target.variables import RaveledVariables
from .mirrors import mirrors_within
from .words import sentences

_LEAST_SHARE = 0.02  # of the points; fewer have only not moved yet
_APART = 2.0  # standard deviations within the modes: variables that differ between them
_MOST_NAMED = 4  # variables in the message
_SECONDS = 1.0  # of a processor, to find mirror images
_N_COMPARED = 50  # points of each mode, whose means are compared

_LABELS = (
    " They have the same values in another order, as if labels were exchanged, such as those of "
    "regimes. If they may be, the modes are one: keep an order of a vector of them "
    "(transform=pm.distributions.transforms.ordered, initval=increasing values)."
)

Array = NDArray[np.float64]


@sentences.register
def _(fact: SeparateModes) -> list[str]:
    """Describe the modes, if there are several: where they are highest, and their shares."""
    model, raveled, points = fact.model, fact.raveled, fact.points
    numbers, counts = np.unique(points.mode, return_counts=True)
    shares = counts / len(points.mode)
    large = sorted(np.flatnonzero(shares >= _LEAST_SHARE), key=lambda i: -shares[i])
    if len(large) < 2:
        return []
    members = [np.flatnonzero(points.mode == numbers[i]) for i in large]
    if fact.before_run and _are_mirrored(model, [points.x[of_mode] for of_mode in members]):
        return []
    highest = [of_mode[points.log_density[of_mode].argmax()] for of_mode in members]
    names = _differing(model, raveled, [points.x[of_mode] for of_mode in members])
    at = ConstrainedValues(model)
    values = [at(points.x[i]) for i in highest]
    described = [
        f"at {', '.join(f'{name}={_short(value[name])}' for name in names)} "
        f"(share {shares[i]:.2f}, log-density {points.log_density[top]:.1f})"
        for i, top, value in zip(large, highest, values, strict=True)
    ]
    of_modes = [[at(x) for x in points.x[some[:_N_COMPARED]]] for some in members]
    advice = _LABELS if _are_orders(of_modes) else f" {ALL_MODES[0].upper()}{ALL_MODES[1:]}."
    return [
        f"The posterior has {len(large)} separate modes: {' and '.join(described)}. A mean over "
        f"all modes may lie in none of them.{advice}"
    ]


def _are_mirrored(model: Model, modes: Sequence[Array]) -> bool:
    """Whether the modes are mirror images of one."""
    if noise_seeds(model):
        return False
    x, evaluate = np.concatenate(modes)[np.newaxis], ModelDensity(model).evaluate
    if not (mirrors := mirrors_within(_SECONDS, model, x, evaluate)):
        return False
    parts = np.split(mirrors[-1].folded[0], np.cumsum([len(mode) for mode in modes])[:-1])
    means, sds = (np.array([f(mode, axis=0) for mode in parts]) for f in (np.mean, np.std))
    return bool((np.ptp(means, axis=0) <= _APART * sds.max(axis=0)).all())


def _are_orders(modes: Sequence[Sequence[Mapping[str, Array]]]) -> bool:
    """Whether each mode, given by some of its points, has the values of the first, reordered.

    Values change places within their variable, or among the scalar variables.
    """
    first, *others = modes
    names = list(first[0])
    scalars = [name for name in names if np.ndim(first[0][name]) == 0]
    groups = [[name] for name in names if name not in scalars] + ([scalars] if scalars else [])
    return all(_is_order(first, other, group) for other in others for group in groups)


def _is_order(
    one: Sequence[Mapping[str, Array]], other: Sequence[Mapping[str, Array]], names: list[str]
) -> bool:
    values = [
        np.array([np.concatenate([np.ravel(x[name]) for name in names]) for x in mode])
        for mode in (one, other)
    ]
    (first, second), spread = (x.mean(axis=0) for x in values), [x.std(axis=0) for x in values]
    return is_reordered(first, second, np.maximum(*spread))


def _differing(model: Model, raveled: RaveledVariables, modes: list[Array]) -> list[str]:
    """The variables that differ between modes, the most different first."""
    means = np.array([x.mean(axis=0) for x in modes])
    within = np.min([x.std(axis=0) for x in modes], axis=0)  # one may be several, further out
    apart = np.ptp(means, axis=0) / np.where(within > 0, within, np.inf)
    order = np.argsort(-apart)
    chosen = [i for i in order if apart[i] > _APART] or [order[0]]
    return list(dict.fromkeys(raveled.rv_at(model, int(i)).name for i in chosen))[:_MOST_NAMED]


def _short(value: Array) -> str:
    return np.array2string(np.asarray(value), precision=3, threshold=6, edgeitems=2)
