"""Scales on which a parameter moves: the parameter is a smooth function of an unbounded number."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.tensor.variable import TensorVariable
from scipy.special import expit

from ..errors import ModelError
from .checks import check_finite

Array = NDArray[np.float64]

# Gauss-Hermite points for the moments of a bounded parameter.
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(101)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


class Link(Protocol):
    """A scale: from a parameter to the number that moves, and back."""

    def forward(self, value: TensorVariable) -> TensorVariable:
        """The number of a parameter's value; NaN or infinite outside the scale."""
        ...

    def inverse(self, number: TensorVariable) -> TensorVariable:
        """The parameter's value."""
        ...

    def values(self, numbers: Array) -> Array:
        """The parameter's values, of an array."""
        ...

    def moments(self, mean: Array, sd: Array) -> tuple[Array, Array]:
        """Mean and standard deviation of the parameter where its number is normal."""
        ...

    def contains(self, value: Any) -> bool:
        """Whether all values lie on the scale."""
        ...


@dataclass(frozen=True)
class Identity:
    """The parameter itself."""

    def forward(self, value: TensorVariable) -> TensorVariable:
        """The value."""
        return value

    def inverse(self, number: TensorVariable) -> TensorVariable:
        """The number."""
        return number

    def values(self, numbers: Array) -> Array:
        """The numbers."""
        return numbers

    def moments(self, mean: Array, sd: Array) -> tuple[Array, Array]:
        """Those of the number."""
        return mean, sd

    def contains(self, value: Any) -> bool:
        """Every number is on the scale."""
        return bool(np.isfinite(value).all())


@dataclass(frozen=True)
class Log:
    """The logarithm of a positive parameter."""

    def forward(self, value: TensorVariable) -> TensorVariable:
        """The logarithm."""
        return pt.log(value)

    def inverse(self, number: TensorVariable) -> TensorVariable:
        """The exponential."""
        return pt.exp(number)

    def values(self, numbers: Array) -> Array:
        """The exponentials."""
        return np.exp(numbers)

    def moments(self, mean: Array, sd: Array) -> tuple[Array, Array]:
        """Those of the log-normal law."""
        with np.errstate(over="ignore"):
            expected = np.exp(mean + 0.5 * sd**2)
            return expected, expected * np.sqrt(np.expm1(sd**2))

    def contains(self, value: Any) -> bool:
        """Positive numbers."""
        return bool((np.isfinite(value) & (np.asarray(value) > 0)).all())


@dataclass(frozen=True)
class Logit:
    """The log-odds of the place of a parameter between two bounds."""

    low: float
    high: float

    def forward(self, value: TensorVariable) -> TensorVariable:
        """The log-odds."""
        return pt.log(value - self.low) - pt.log(self.high - value)

    def inverse(self, number: TensorVariable) -> TensorVariable:
        """The value between the bounds."""
        return self.low + (self.high - self.low) * pt.sigmoid(number)

    def values(self, numbers: Array) -> Array:
        """The values between the bounds."""
        return self.low + (self.high - self.low) * expit(numbers)

    def moments(self, mean: Array, sd: Array) -> tuple[Array, Array]:
        """By quadrature."""
        at = self.values(mean[..., None] + sd[..., None] * _NODES)
        expected = at @ _WEIGHTS
        return expected, np.sqrt((at - expected[..., None]) ** 2 @ _WEIGHTS)

    def contains(self, value: Any) -> bool:
        """Numbers between the bounds."""
        return bool(((np.asarray(value) > self.low) & (np.asarray(value) < self.high)).all())


_NAMED: dict[str, Callable[[], Link]] = {"identity": Identity, "log": Log}


def read_scale(scale: Any) -> Link:
    """The link of a scale as a user writes it."""
    if isinstance(scale, str) and scale in _NAMED:
        return _NAMED[scale]()
    if isinstance(scale, tuple | list) and len(scale) == 3 and scale[0] == "logit":
        low, high = (check_finite(f"scale {name}", one) for name, one in zip(
            ("low", "high"), scale[1:], strict=True
        ))  # fmt: skip
        if low < high:
            return Logit(low, high)
    raise ModelError(
        'scale must be "identity", "log" (positive parameters) or ("logit", low, high) with '
        f"low < high, got {scale!r}"
    )
