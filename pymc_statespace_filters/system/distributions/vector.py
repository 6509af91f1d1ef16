"""Distributions of vectors, and of categories, as functions of standard normals."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import pytensor.tensor as pt
import pytensor.tensor.random.basic as ptr
from pytensor.tensor.linalg import cholesky
from pytensor.tensor.variable import TensorVariable

from ..quantiles import normal_probability
from .finite import are_probabilities
from .scalar import COUNT, PROBABILITY, REAL, SCALAR_LAWS, Domain, root


class CategoricalLaw:
    """The number of a category: how many of the cumulated probabilities a uniform exceeds."""

    is_discrete, is_gaussian = True, False
    domains: ClassVar[dict[str, Domain]] = {"p": PROBABILITY}

    def count(self, shape: tuple[int, ...], parameters: Sequence[TensorVariable]) -> int:
        """One normal for each number."""
        return int(np.prod(shape, dtype=int))

    def draw(
        self, z: TensorVariable, shape: tuple[int, ...], parameters: Sequence[TensorVariable]
    ) -> TensorVariable:
        """A draw from the normals ``z``."""
        (p,) = parameters
        uniform, category, below = normal_probability(z.reshape(shape)), 0.0, 0.0
        for k in range(p.type.shape[-1] - 1):
            below = below + p[..., k]
            category = category + pt.gt(uniform, below)
        return pt.switch(are_probabilities(p), category, np.nan)

    def surrogate(
        self, z: TensorVariable, shape: tuple[int, ...], parameters: Sequence[TensorVariable]
    ) -> TensorVariable:
        """Mean and standard deviation times a normal."""
        (p,) = parameters
        numbers = np.arange(p.type.shape[-1], dtype="float64")
        mean = pt.sum(p * numbers, axis=-1)
        variance = pt.sum(p * numbers**2, axis=-1) - mean**2
        return mean + root(variance) * z.reshape(shape)


class MultinomialLaw:
    """Counts of categories: binomial ones, each of what the earlier ones left."""

    is_discrete, is_gaussian = True, False
    domains: ClassVar[dict[str, Domain]] = {"n": COUNT, "p": PROBABILITY}

    def count(self, shape: tuple[int, ...], parameters: Sequence[TensorVariable]) -> int:
        """A normal for each category but the last, which takes the rest."""
        return shape[0] - 1

    def draw(
        self, z: TensorVariable, shape: tuple[int, ...], parameters: Sequence[TensorVariable]
    ) -> TensorVariable:
        """A draw from the normals ``z``."""
        drawn = self._sequence(SCALAR_LAWS[ptr.BinomialRV].draw, z, shape, parameters)
        return pt.switch(are_probabilities(parameters[1]), drawn, np.nan)

    def surrogate(
        self, z: TensorVariable, shape: tuple[int, ...], parameters: Sequence[TensorVariable]
    ) -> TensorVariable:
        """The same with normal variables of the mean and variance of each binomial one."""
        return self._sequence(SCALAR_LAWS[ptr.BinomialRV].surrogate, z, shape, parameters)

    def _sequence(
        self,
        binomial: Callable,
        z: TensorVariable,
        shape: tuple[int, ...],
        parameters: Sequence[TensorVariable],
    ) -> TensorVariable:
        rest, p = parameters
        counts = []
        for k, share in enumerate(conditional_shares([p[i] for i in range(shape[0])])[:-1]):
            counts.append(binomial(z[k : k + 1], (), [rest, share]))
            rest = rest - counts[-1]
        return pt.stack([*counts, rest])


class MvNormalLaw:
    """A normal vector."""

    is_discrete, is_gaussian = False, True
    domains: ClassVar[dict[str, Domain]] = {"mu": REAL, "cov": REAL}

    def count(self, shape: tuple[int, ...], parameters: Sequence[TensorVariable]) -> int:
        """One normal for each component."""
        return shape[0]

    def draw(
        self, z: TensorVariable, shape: tuple[int, ...], parameters: Sequence[TensorVariable]
    ) -> TensorVariable:
        """A draw from the normals ``z``."""
        mu, cov = parameters
        return mu + cholesky(cov, lower=True) @ z

    surrogate = draw


def conditional_shares(shares: Sequence[Any], left: Any = 0.0) -> list[TensorVariable]:
    """What each share is of itself, those after it and ``left``; 0 where all of them are zero.

    Sums run from the end, so that rounding makes no share larger than 1.
    """
    found: list[TensorVariable] = []
    for share in reversed(shares):
        left = left + share
        found.append(pt.switch(pt.eq(left, 0), 0.0, share / pt.switch(pt.eq(left, 0), 1.0, left)))
    return found[::-1]
