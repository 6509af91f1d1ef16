"""Parameters whose sign has no meaning, though the draws have both: a scale with a normal prior."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from pymc.model import Model
from pytensor.graph.traversal import ancestors

from ..pymc_model.elements import Elements
from ..pymc_model.inspection import state_space_nodes

_LEAST_SHARE = 0.02  # of the draws, with the rarer sign
_N_POINTS = 8

Array = NDArray[np.float64]


def signs_message(model: Model, draws: Array, evaluate: Callable[[Array], Array]) -> str | None:
    """Name an element of draws (n, k) with the same density at the opposite sign, if there is one.

    Only variables without a transform that a StateSpace variable depends on: others may well be
    symmetric.
    """
    for i in with_both_signs(model, draws):
        if is_symmetric(draws, i, evaluate):
            return sign_text(Elements.of(model).labels[i], float((draws[:, i] < 0).mean()))
    return None


def sign_text(name: str, share: float) -> str:
    """Say that a sign has no meaning, which is negative in this share of the draws."""
    return (
        f"the density is the same at {name} and -{name}, and {share:.0%} of the draws are "
        f"negative, so that the mean and the intervals of {name} say nothing of its size. "
        f"If {name} is a scale, give it a positive prior, such as pm.HalfNormal"
    )


def with_both_signs(model: Model, draws: Array) -> list[int]:
    """The elements of draws (n, k) that may be scales, of which some draws are negative."""
    parameters = [node.inputs[-5] for node in state_space_nodes(model).values()]
    free = [rv for rv, transform in model.rvs_to_transforms.items() if transform is None]
    used = {rv.name for rv in set(free) & set(ancestors(parameters))}
    negative = (draws < 0).mean(axis=0)
    is_both = np.minimum(negative, 1 - negative) >= _LEAST_SHARE
    variables = Elements.of(model).variables
    return [i for i, both in enumerate(is_both) if both and variables[i] in used]


def is_symmetric(draws: Array, i: int, evaluate: Callable[[Array], Array]) -> bool:
    """Whether the density is the same at the opposite sign of an element."""
    x = draws[np.linspace(0, len(draws) - 1, _N_POINTS).astype(int)]
    return np.allclose(evaluate(x), evaluate(reflected(x, i)), rtol=1e-9, atol=0.0)


def reflected(x: Array, i: int) -> Array:
    """Points (n, k) with the opposite sign of an element."""
    return x * np.where(np.arange(x.shape[1]) == i, -1.0, 1.0)
