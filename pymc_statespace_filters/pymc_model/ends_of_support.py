"""Where the support of a free variable begins and ends, whatever transform the model gives it."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from numpy.typing import NDArray
from pymc.distributions.transforms import _default_transform
from pymc.logprob.transforms import IntervalTransform, LogOddsTransform, LogTransform
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

Array = NDArray[np.float64]


def bounds_of_support(rv: TensorVariable) -> tuple[TensorVariable, TensorVariable]:
    """Ends of the support as graphs; infinite where there are none, or none that are known."""
    support = _default_transform(rv.owner.op, rv)
    ends: tuple[TensorVariable | None, TensorVariable | None] = (None, None)
    if isinstance(support, LogTransform):
        ends = (pt.constant(0.0), None)
    elif isinstance(support, LogOddsTransform):
        ends = (pt.constant(0.0), pt.constant(1.0))
    elif isinstance(support, IntervalTransform):
        ends = support.args_fn(*rv.owner.inputs)
    lower, upper = ends
    return (
        pt.constant(-np.inf) if lower is None else lower,
        pt.constant(np.inf) if upper is None else upper,
    )


def ends_of_support(rv: TensorVariable, model: pm.Model) -> tuple[Array, Array] | None:
    """Ends of the support of every scalar, (k,) each; None if they depend on other variables."""
    bounds = bounds_of_support(rv)
    if set(ancestors(bounds)) & set(model.basic_RVs):
        return None
    shape = model.eval_rv_shapes()[rv.name]
    lower, upper = (
        np.broadcast_to(bound.eval(mode="FAST_COMPILE"), shape).astype(float).ravel()
        for bound in bounds
    )
    return lower, upper
