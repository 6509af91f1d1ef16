"""The strengths of drift among the free variables of a model, at draws on the unconstrained space.

A strength is zero or positive, or of either sign if the likelihood is even in it; at zero the
parameter is constant.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

from ...errors import ModelError
from ...pymc_model.at_points import GraphsAtPoints
from ...pymc_model.ends_of_support import ends_of_support
from ...pymc_model.inspection import parameter_graphs, state_space_nodes
from ...pymc_model.prior import is_improper

Array = NDArray[np.float64]


class Strengths(NamedTuple):
    """Scalars of some free variables at n points.

    ``sizes`` (n, d) are their absolute values; ``log_jacobian`` (n,) is that of the values by the
    unconstrained vector. ``largest`` (d,) is the end of the support, and ``is_signed`` (d,) whether
    it reaches as far below zero.
    """

    sizes: Array
    log_jacobian: Array
    largest: Array
    is_signed: NDArray[np.bool_]


def chosen_strengths(model: pm.Model, names: str | Iterable[str] | None) -> list[str]:
    """Check that free variables can be strengths; return their names, each once."""
    if names is None:
        names = _strengths_of_systems(model)
    chosen = list(dict.fromkeys([names] if isinstance(names, str) else names))
    free = [rv.name for rv in model.free_RVs]
    if not chosen:
        raise ModelError("var_names must name at least one free variable, got none")
    if unknown := [name for name in chosen if name not in free]:
        raise ModelError(f"var_names must be free variables of the model, {free}, got {unknown}")
    if set(chosen) == set(free):
        raise ModelError(
            f"model must have a free variable beside the strengths {chosen}: without one the "
            "constant model has a likelihood and no posterior; compare it with estimate_evidence"
        )
    for name in chosen:
        if is_improper(model[name], model):
            raise ModelError(
                f"the prior of {name!r} is improper or not normalised, and the Bayes factor is "
                "proportional to its unknown density: give it a proper prior, such as "
                f"pm.HalfNormal({name!r}, ...)"
            )
    return chosen


def _strengths_of_systems(model: pm.Model) -> Iterator[str]:
    """The free variables that are strengths of drifting parameters of the observed systems."""
    free, found = set(model.free_RVs), False
    for node in state_space_nodes(model).values():
        graphs = parameter_graphs(node)
        for name in dict.fromkeys(one.strength for one in node.op.system.drifting):
            graph = graphs.get(name)
            known = set() if graph is None else set(ancestors([graph], blockers=free))
            variables = [rv.name for rv in model.free_RVs if rv in known]
            if len(variables) > 1:
                raise ModelError(
                    f"var_names must name the free variable that is the strength {name!r}, which "
                    f"depends on {sorted(variables)}"
                )
            found = found or bool(variables)
            yield from variables
    if not found:
        raise ModelError(
            "var_names must name the strengths of the drift, free variables that are zero if "
            "nothing drifts: no system of the model is made by psf.drifting and has a strength "
            "with a prior"
        )


class StrengthsAtPoints:
    """The values of free variables with these names at points of the unconstrained space.

    Raises `ModelError` if zero is neither the lower end nor the middle of the support of one.
    """

    def __init__(self, model: pm.Model, names: Sequence[str]) -> None:
        chosen = [model[name] for name in names]
        ends = [_ends(rv, model) for rv in chosen]
        self._largest = np.concatenate([largest for largest, _ in ends])
        self._is_signed = np.concatenate([is_signed for _, is_signed in ends])
        scalars = pt.concatenate([pt.flatten(rv) for rv in chosen])
        jacobian = pt.sum(pt.stack([_log_jacobian(rv, model) for rv in chosen]))
        self._at_points = GraphsAtPoints(model, [scalars, jacobian])

    def __call__(self, x: Array) -> Strengths:
        """At points x (n, k)."""
        scalars, log_jacobian = self._at_points(x)
        return Strengths(np.abs(scalars), log_jacobian, self._largest, self._is_signed)


def _log_jacobian(rv: TensorVariable, model: pm.Model) -> TensorVariable:
    transform = model.rvs_to_transforms[rv]
    if transform is None:
        return pt.constant(0.0)
    return pt.sum(transform.log_jac_det(model.rvs_to_values[rv], *rv.owner.inputs))


def _ends(rv: TensorVariable, model: pm.Model) -> tuple[Array, NDArray[np.bool_]]:
    """The end of the support of every scalar, (d,), and whether it reaches as far below zero."""
    ends = ends_of_support(rv, model)
    if ends is None:
        raise ModelError(f"the support of {rv.name!r} must not depend on other variables")
    lower, upper = ends
    is_signed = lower == -upper
    if not (is_signed | (lower == 0)).all():
        raise ModelError(
            f"the support of {rv.name!r} must begin at zero, where the parameter is constant, or "
            f"be symmetric about it, got {lower.min():g} to {upper.max():g}"
        )
    return upper, is_signed
