"""What helps chains of a model that mix slowly, by name."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pymc.logprob.transforms import LogTransform
from pymc.model import Model
from pytensor.graph.traversal import ancestors
from scipy.stats import skew

from ...pymc_model.inspection import gradient_obstacle, kinked_variable, noisy_filters

# A posterior reaches zero if at least this share of the draws is below a tenth of the mean, and if
# logarithms have this skewness: -1.1 with the exponential distribution, -1.5 with the half-normal,
# zero with a lognormal one of any width.
_LEAST_SHARE, _MOST_SKEWNESS = 0.01, -1.0

Array = NDArray[np.float64]


def ways_to_mix(model: Model, names: Sequence[str], positions: Array, slowest: str) -> str:
    """What works for this model if chains of `sample_dram` are slow along one element.

    ``positions`` (n, k) are draws of the elements with these ``names``, unconstrained.
    """
    if (name := reaches_zero(model, names, positions)) is not None:
        ways = [f"or {without_transform(name)}"]
    else:
        ways = ["tune longer"]
        if not gradient_obstacle(model) and kinked_variable(model) is None:
            ways.append("use psf.sample(sampler='nuts')")
        ways.append(f"or reparametrise {slowest}")
    if noisy_filters(model):
        ways.insert(-1, "give the filter more particles (psf.suggest_particles)")
    return ", ".join(ways)


def without_transform(name: str) -> str:
    """What to do with a variable that reaches zero."""
    return (
        f"sample {name} as it is, whose logarithm has a long tail as its posterior reaches zero "
        "(default_transform=None, sampler='dram')"
    )


def reaches_zero(model: Model, names: Sequence[str], positions: Array) -> str | None:
    """The positive variable whose posterior density at zero is largest, None if it is none.

    On the scale of its logarithm such a posterior is bent: the tail towards zero goes along the
    logarithm alone, and the rest along all parameters that can make up for it. The scale of other
    variables is left out: near zero these lie close together on every scale.
    """
    shares = {}
    for i, name in enumerate(names):
        rv = model[name.partition("[")[0]]
        if isinstance(model.rvs_to_transforms[rv], LogTransform) and not _is_parent(model, rv):
            log_x = positions[:, i]
            x = np.exp(log_x - log_x.max())
            near = float((x < 0.1 * x.mean()).mean())
            if near > _LEAST_SHARE and skew(log_x) < _MOST_SKEWNESS:
                shares[rv.name] = near
    return max(shares, key=lambda name: shares[name], default=None)


def _is_parent(model: Model, rv: object) -> bool:
    """Whether the prior of another free variable depends on this one."""
    return any(rv in ancestors([other]) for other in model.free_RVs if other is not rv)
