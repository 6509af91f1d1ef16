"""The coefficients whose priors are optimised: where they are, and the priors that they have."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pymc.model.transform.conditioning import remove_value_transforms
from pytensor.graph.traversal import ancestors
from pytensor.tensor.random.basic import NormalRV
from pytensor.tensor.variable import TensorVariable

from ...errors import ModelError
from ...evidence.comparison.scaled_prior import bounds_of_support
from ...pymc_model.elements import Elements

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ChosenTerms:
    """The p coefficients of the terms, and their priors in the model of the draws.

    Attributes
    ----------
    names : tuple of str
    model : pymc.Model
        The model without transforms of these variables, which are thus part of its vector.
    columns : ndarray of int, shape (p,)
        Their places in this vector.
    prior_mean, prior_precision : ndarray (p,)
        Of normal priors; the precision of any other prior is zero.
    """

    names: tuple[str, ...]
    model: pm.Model
    columns: NDArray[np.int64]
    prior_mean: Array
    prior_precision: Array


def chosen_terms(model: pm.Model, names: str | Iterable[str]) -> ChosenTerms:
    """Check the argument ``names`` of `relevance`."""
    elements = Elements.of(model)
    given = list(dict.fromkeys([names] if isinstance(names, str) else names))
    chosen = list(dict.fromkeys(one for name in given for one in elements.columns(name, "names")))
    if not chosen:
        raise ModelError(f"names must name at least one of {list(elements.labels)}, got none")
    of_chosen = {elements.variables[one] for one in chosen}
    variables = [rv for rv in model.free_RVs if rv.name in of_chosen]
    for rv in variables:
        _check_prior(rv, model)
    priors: dict[int, tuple[float, float]] = {}
    for rv in variables:
        columns = [one for one, name in enumerate(elements.variables) if name == rv.name]
        priors |= dict(zip(columns, _normal_priors(rv, model), strict=True))
    mean, precision = np.array([priors[one] for one in chosen]).T
    labels = tuple(elements.labels[one] for one in chosen)
    plain = remove_value_transforms(model, variables)
    places = Elements.of(plain).labels  # in another order
    return ChosenTerms(labels, plain, np.array(list(map(places.index, labels))), mean, precision)


def _check_prior(rv: TensorVariable, model: pm.Model) -> None:
    """Raise unless the elements have a prior of their own, on both sides of zero."""
    if rv.owner.op.ndim_supp:
        raise ModelError(
            f"names must be coefficients with independent priors, got {rv.name!r} with a joint "
            f"prior ({type(rv.owner.op).__name__}): give it pm.Normal"
        )
    if others := [one.name for one in set(ancestors([rv])) & set(model.basic_RVs) - {rv}]:
        raise ModelError(
            f"names must be coefficients whose priors are known, got {rv.name!r}, whose prior "
            f"depends on {sorted(others)}: relevance chooses the width of the prior itself, so "
            f"give it a fixed one, such as pm.Normal({rv.name!r}, 0, 1)"
        )
    lower, upper = (end.eval(mode="FAST_COMPILE") for end in bounds_of_support(rv))
    if not ((lower < 0).all() and (upper > 0).all()):
        raise ModelError(
            f"names must be coefficients of either sign, got {rv.name!r} with values from "
            f"{lower.min():g} to {upper.max():g}: its absence is at the end of its support; use "
            "select_terms"
        )


def _normal_priors(rv: TensorVariable, model: pm.Model) -> Iterator[tuple[float, float]]:
    """Mean and precision of the prior of every element; zeros if it is not normal."""
    shape = tuple(map(int, model.eval_rv_shapes()[rv.name]))
    if not isinstance(rv.owner.op, NormalRV):
        yield from [(0.0, 0.0)] * int(np.prod(shape))
        return
    parameters = (one.eval(mode="FAST_COMPILE") for one in rv.owner.op.dist_params(rv.owner))
    mean, sd = (np.broadcast_to(one, shape).astype(float).ravel() for one in parameters)
    yield from zip(mean, sd**-2, strict=True)
