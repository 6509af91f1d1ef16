"""Supports of the priors: volume of Uniform ones, improper and unnormalised priors."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pymc as pm
from pymc.distributions.continuous import FlatRV, HalfFlatRV
from pymc.distributions.multivariate import ICARRV
from pymc.pytensorf import compile as compile_pymc
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import ancestors
from pytensor.tensor.random.basic import UniformRV
from pytensor.tensor.variable import TensorVariable

_IMPROPER = (FlatRV, HalfFlatRV, ICARRV)  # PyMC's densities without a finite integral
_N_TRIED = 50  # draws to test whether a transform is invertible on the whole support


@dataclass(frozen=True)
class Support:
    """The fields of `Evidence` of the same names."""

    log_volume: float
    uniform: str
    improper: str

    @classmethod
    def of(cls, model: pm.Model) -> "Support":
        """Inspect the priors of a model's free variables."""
        widths = {rv.name: log_widths for rv in model.free_RVs for log_widths in _widths(rv, model)}
        improper = [rv.name for rv in model.free_RVs if is_improper(rv, model)]
        return cls(float(sum(widths.values())), ", ".join(widths), ", ".join(improper))

    def check(self) -> Iterator[str]:
        """Yield a reason if a prior is improper."""
        if self.improper:
            yield (
                f"the prior of {self.improper} is improper or not normalised, so that the evidence "
                "depends on the units of the parameters: give them proper priors"
            )


def is_improper(rv: TensorVariable, model: pm.Model) -> bool:
    """Whether the density of a free variable is known not to integrate to one."""
    return not can_sample(rv, model) or is_restricted(rv, model)


def can_sample(rv: TensorVariable, model: pm.Model) -> bool:
    """Whether a prior can be sampled; false for PyMC's improper distributions."""
    return not any(isinstance(op, _IMPROPER) for op in _operations(rv, model))


def _operations(rv: TensorVariable, model: pm.Model) -> Iterator[object]:
    """The operations in a variable's distribution, down to the other variables of the model."""
    others = {other for other in model.basic_RVs if other is not rv}
    pending: list[Variable] = [v for v in ancestors([rv], blockers=others) if v not in others]
    while pending:
        owner = pending.pop().owner
        if owner is not None:
            yield owner.op
            # A compound distribution holds its components in an inner graph.
            pending.extend(ancestors(getattr(owner.op, "inner_outputs", ())))


def is_restricted(rv: TensorVariable, model: pm.Model) -> bool:
    """Whether a transform excludes a part of the support, as an ordering does.

    The density is then restricted to a part of its support without being normalised, and random
    draws do not survive a round trip through the transform.
    """
    transform = model.rvs_to_transforms[rv]
    if transform is None:
        return False
    unconstrained = transform.forward(rv, *rv.owner.inputs)
    back = transform.backward(unconstrained, *rv.owner.inputs)
    try:
        # Too few calls to be worth machine code.
        draw = compile_pymc([], [rv, back], random_seed=0, mode="FAST_COMPILE")
        pairs = [draw() for _ in range(_N_TRIED)]
    except NotImplementedError:  # it, or a variable it depends on, cannot be sampled
        return False
    return not all(np.allclose(before, after, rtol=1e-4) for before, after in pairs)


def _widths(rv: TensorVariable, model: pm.Model) -> Iterator[float]:
    """Sum of the log widths of a prior, if it is Uniform with constant bounds."""
    if not isinstance(rv.owner.op, UniformRV):
        return
    bounds = rv.owner.op.dist_params(rv.owner)
    if set(ancestors(bounds)) & set(model.basic_RVs):
        return
    shape = model.eval_rv_shapes()[rv.name]
    lower, upper = (bound.eval(mode="FAST_COMPILE").astype(np.float64) for bound in bounds)
    yield float(np.log(np.broadcast_to(upper - lower, shape)).sum())
