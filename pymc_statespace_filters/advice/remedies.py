"""What helps chains of a model that mix slowly, by name."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pymc.logprob.transforms import LogTransform
from pymc.model import Model
from pytensor.graph.traversal import ancestors
from scipy.stats import skew

from ..checks.coverage import ALL_MODES
from ..pymc_model.inspection import noisy_filters
from ..tables import joined

# A posterior reaches zero if at least this share of the draws is below a tenth of the mean, and if
# logarithms have this skewness: -1.1 with the exponential distribution, -1.5 with the half-normal,
# zero with a lognormal one of any width.
_LEAST_SHARE, _MOST_SKEWNESS = 0.01, -1.0
_LEAST_SIDE, _GAP = 0.02, 0.2  # of the draws, beside a gap; of their range without the ends
_LEAST_CORRELATION = 0.5  # with another parameter, that can make up for it
_TOGETHER, _MOST_NAMED = 0.75, 8  # correlation of those that move together

Array = NDArray[np.float64]


def alternatives(ways: Sequence[str]) -> str:
    """Things to do, of which one is enough: the end of a sentence."""
    return ", or ".join([", ".join(ways[:-1]), ways[-1]] if len(ways) > 1 else ways)


def ways_to_mix(model: Model, names: Sequence[str], positions: Array, slowest: str) -> list[str]:
    """What works for this model if chains of `sample_dram` are slow along one element.

    ``positions`` (n, k) are draws of the elements with these ``names``, unconstrained.
    """
    if _is_divided(positions[:, list(names).index(slowest)]):
        ways = [ALL_MODES]
    elif (name := reaches_zero(model, names, positions)) is not None:
        ways = [without_transform(name)]
    else:
        ways = ["tune longer", reparametrise(names, positions, slowest)]
    if noisy_filters(model):
        ways.insert(-1, "give the filter more particles (psf.suggest_particles)")
    return ways


def reparametrise(names: Sequence[str], positions: Array, slowest: str) -> str:
    """What to do about the slowest element: with those that move along with it, if there are any.

    As where data know a ratio alone: any of its parts may be the slowest.
    """
    i = list(names).index(slowest)
    with np.errstate(invalid="ignore", divide="ignore"):  # an element that has not moved
        sizes = np.abs(np.corrcoef(positions, rowvar=False).reshape(len(names), -1)[i])
    together = [j for j in np.argsort(-sizes, kind="stable") if sizes[j] > _TOGETHER]
    if len(together) < 2:
        return f"reparametrise {slowest}"
    named = joined(names[j] for j in sorted(together[:_MOST_NAMED]))
    others = sizes[together[1:]]
    return (
        f"fix one of {named}, which move together (correlations of "
        f"{others.min():.2f} to {others.max():.2f} with {slowest}), or write the others relative "
        "to it"
    )


def without_transform(name: str) -> str:
    """What to do with a variable that reaches zero."""
    return (
        f"sample {name} as it is, whose logarithm has a long tail as its posterior reaches zero "
        "(default_transform=None)"
    )


def reaches_zero(model: Model, names: Sequence[str], positions: Array) -> str | None:
    """The positive variable that reaches zero and is most correlated with others, if there is one.

    On the scale of its logarithm such a posterior is bent: the tail towards zero goes along the
    logarithm alone, and the rest along all parameters that can make up for it. The scale of other
    variables is left out: near zero these lie close together on every scale.
    """
    found = {}
    for i, name in enumerate(names):
        rv, log_x = model[name.partition("[")[0]], positions[:, i]
        if isinstance(model.rvs_to_transforms[rv], LogTransform) and not _is_parent(model, rv):
            x = np.exp(log_x - log_x.max())
            is_near = float((x < 0.1 * x.mean()).mean()) > _LEAST_SHARE
            if is_near and skew(log_x) < _MOST_SKEWNESS:
                found[rv.name] = _largest_correlation(x, np.delete(positions, i, axis=1))
    most = max(found, key=lambda name: found[name], default=None)
    return most if most is not None and found[most] > _LEAST_CORRELATION else None


def _is_divided(x: Array) -> bool:
    """Whether draws (n,) are in groups far from each other, as those of separate modes."""
    low, high = np.quantile(x, [_LEAST_SIDE, 1 - _LEAST_SIDE])
    inside = np.sort(x[(x >= low) & (x <= high)])
    return bool(np.diff(inside).max(initial=0.0) > _GAP * (high - low))


def _largest_correlation(x: Array, others: Array) -> float:
    """Of x (n,) with others (n, k), regardless of the sign."""
    centred = others - others.mean(axis=0)
    scale = np.maximum(centred.std(axis=0), np.finfo(float).tiny)
    z = (x - x.mean()) / max(x.std(), np.finfo(float).tiny)
    return float(np.abs(z @ (centred / scale) / len(x)).max(initial=0.0))


def _is_parent(model: Model, rv: object) -> bool:
    """Whether the prior of another free variable depends on this one."""
    return any(rv in ancestors([other]) for other in model.free_RVs if other is not rv)
