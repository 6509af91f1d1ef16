"""What an evidence owes to the supports of the priors: their volume, and whether they have one."""

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

# PyMC's densities that have no integral.
_IMPROPER = (FlatRV, HalfFlatRV, ICARRV)
_N_TRIED = 50  # draws that a transform must bear


@dataclass(frozen=True)
class Support:
    """The fields of `Evidence` of the same names."""

    log_volume: float
    uniform: str
    improper: str

    @classmethod
    def of(cls, model: pm.Model) -> "Support":
        """Read the priors of a model's free variables; nothing is drawn."""
        widths = {rv.name: log_widths for rv in model.free_RVs for log_widths in _widths(rv, model)}
        improper = [rv.name for rv in model.free_RVs if is_improper(rv, model)]
        return cls(float(sum(widths.values())), ", ".join(widths), ", ".join(improper))

    def check(self) -> Iterator[str]:
        """An evidence under an improper prior says little about a model."""
        if self.improper:
            yield (
                f"the prior of {self.improper} is improper or not normalised, so that the evidence "
                "depends on the unit of each: give it a proper prior"
            )


def is_improper(rv: TensorVariable, model: pm.Model) -> bool:
    """Whether the density of a free variable is known not to integrate to one."""
    return not can_sample(rv, model) or is_restricted(rv, model)


def can_sample(rv: TensorVariable, model: pm.Model) -> bool:
    """Whether there is a law to draw from, as far as PyMC's own distributions are concerned."""
    return not any(isinstance(op, _IMPROPER) for op in _operations(rv, model))


def _operations(rv: TensorVariable, model: pm.Model) -> Iterator[object]:
    """What a variable's own law is made of, down to the other variables of the model."""
    others = {other for other in model.basic_RVs if other is not rv}
    pending: list[Variable] = [v for v in ancestors([rv], blockers=others) if v not in others]
    while pending:
        owner = pending.pop().owner
        if owner is not None:
            yield owner.op
            # A distribution made of others holds them in a graph of its own.
            pending.extend(ancestors(getattr(owner.op, "inner_outputs", ())))


def is_restricted(rv: TensorVariable, model: pm.Model) -> bool:
    """Whether a transform leaves a part of the support out, as an ordering does.

    Such a density is that of the law, on a part of its support, and nothing normalises it. What a
    variable's law may draw then does not survive the way there and back.
    """
    transform = model.rvs_to_transforms[rv]
    if transform is None:
        return False
    there = transform.forward(rv, *rv.owner.inputs)
    back = transform.backward(there, *rv.owner.inputs)
    try:
        # Few calls: not worth machine code.
        draw = compile_pymc([], [rv, back], random_seed=0, mode="FAST_COMPILE")
        pairs = [draw() for _ in range(_N_TRIED)]
    except NotImplementedError:  # it, or what it depends on, has no law: nobody can tell
        return False
    return not all(np.allclose(before, after, rtol=1e-4) for before, after in pairs)


def _widths(rv: TensorVariable, model: pm.Model) -> Iterator[float]:
    """Sum of the log widths of a Uniform prior, if it is one and its bounds are constant."""
    if not isinstance(rv.owner.op, UniformRV):
        return
    bounds = rv.owner.op.dist_params(rv.owner)
    if set(ancestors(bounds)) & set(model.basic_RVs):
        return
    shape = model.eval_rv_shapes()[rv.name]
    lower, upper = (bound.eval(mode="FAST_COMPILE").astype(np.float64) for bound in bounds)
    yield float(np.log(np.broadcast_to(upper - lower, shape)).sum())
