"""Where the support of a free variable begins and ends, and where its density falls to zero."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from numpy.typing import NDArray
from pymc.distributions.transforms import _default_transform
from pymc.logprob.transforms import IntervalTransform, LogOddsTransform, LogTransform
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

N_TRIED = 10  # draws of the variables that a prior depends on
# Distances from a place at which a density is compared, absolute from zero, else relative: the
# formulas of PyMC have no limit at the place itself.
NEAR_ZERO, NEAR = np.array([1e-100, 1e-200]), np.array([[1e-6], [1e-10]])

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


def falls_to_zero(rv: TensorVariable, values: Array, model: pm.Model) -> NDArray[np.bool_]:
    """Whether the density of every scalar of a variable falls to zero towards a value, (k,) each.

    So for all of a few draws of the variables that it depends on. False where elements have a joint
    density, or where these variables cannot be drawn.
    """
    unknown = np.zeros(values.size, dtype=bool)
    if getattr(rv.owner.op, "ndim_supp", None) != 0:
        return unknown
    shape = model.eval_rv_shapes()[rv.name]
    away = [np.where(values == 0, *one) for one in zip(NEAR_ZERO, NEAR * abs(values), strict=True)]
    at = [values, *(values + sign * one for one in away for sign in (1.0, -1.0))]
    densities = [pm.logp(rv, one.reshape(shape)).flatten() for one in at]
    try:
        found = pm.draw(pt.stack(densities), draws=N_TRIED, random_seed=0, mode="FAST_COMPILE")
    except NotImplementedError:
        return unknown
    there, above, below, nearer_above, nearer_below = np.moveaxis(found, 1, 0)
    near, nearer = np.fmax(above, below), np.fmax(nearer_above, nearer_below)
    falls = ~np.isfinite(there) & ~((nearer >= near) & (nearer > -np.inf))
    return np.asarray(falls.all(axis=0))
