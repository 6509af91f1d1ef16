"""Where the prior of a candidate has a density, by the transform of its variable."""

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pymc.logprob.transforms import IntervalTransform, LogOddsTransform, LogTransform
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

Array = NDArray[np.float64]


def support(rv: TensorVariable, model: pm.Model, size: int) -> tuple[Array, Array]:
    """The lower and the upper limits of the elements of a free variable, (size,) each.

    They are infinite where none is known, as for limits that depend on other variables.
    """
    lower, upper = _limits(rv, model)
    return np.resize(lower, size), np.resize(upper, size)


def _limits(rv: TensorVariable, model: pm.Model) -> tuple[Array, Array]:
    transform = model.rvs_to_transforms[rv]
    none = np.array(-np.inf), np.array(np.inf)
    if isinstance(transform, LogTransform):
        return np.array(0.0), none[1]
    if isinstance(transform, LogOddsTransform):
        return np.array(0.0), np.array(1.0)
    if not isinstance(transform, IntervalTransform):
        return none
    found = transform.args_fn(*rv.owner.inputs)
    others = set(model.free_RVs)
    lower, upper = (
        default
        if limit is None or others & set(ancestors([limit]))
        else np.broadcast_to(limit.eval(), rv.shape.eval()).ravel()
        for limit, default in zip(found, none, strict=True)
    )
    return lower, upper
