"""A standard normal below a limit z, as operations: log of its probability, and what is left of it.

Each derivative is an expression of the other operations, so that all have derivatives of any order:
with the hazard h = φ / Φ, the excess e = z + h, the mean of z - Z given Z < z, and the variance v
of Z given Z < z,

    (log Φ)' = h,    h' = -h e,    e' = v,    v' = h (e**2 - v).

`compiler.numerics.quantiles.normal_below` is the machine code, found by the name ``machine_code``,
and accurate however far the limit is; ``impl`` is the slow form, for constants and interpreted
graphs.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytensor.scalar as ps
from pytensor.tensor.elemwise import Elemwise
from scipy import special


class NormalBelow(ps.ScalarOp):
    """A function of the limit z, by the name of its machine code."""

    nin = 1

    def __init__(self, machine_code: str) -> None:
        super().__init__(ps.upgrade_to_float, machine_code)
        self.machine_code = machine_code

    def __eq__(self, other: object) -> bool:
        return isinstance(other, NormalBelow) and self.machine_code == other.machine_code

    def __hash__(self) -> int:
        return hash((NormalBelow, self.machine_code))

    def impl(self, z: float) -> float:
        """The value at a number."""
        return float(_VALUES[self.machine_code](z))

    def pullback(self, inputs: list, outputs: list, cotangents: list) -> list:
        """The derivative, by the other operations."""
        return [cotangents[0] * _SLOPES[self.machine_code](*inputs)]


_log_probability, _hazard, _excess, _variance = map(
    NormalBelow,
    ("normal_log_probability", "normal_hazard", "normal_excess", "normal_variance_below"),
)
log_probability, hazard, excess, variance = map(
    Elemwise, (_log_probability, _hazard, _excess, _variance)
)
_SLOPES: dict[str, Callable[[Any], Any]] = {
    "normal_log_probability": _hazard,
    "normal_hazard": lambda z: -_hazard(z) * _excess(z),
    "normal_excess": _variance,
    "normal_variance_below": lambda z: _hazard(z) * (_excess(z) * _excess(z) - _variance(z)),
}


def _fraction(x: float) -> float:
    """Laplace's continued fraction 2 / (x + 3 / (x + ...)), which is 1 / e - x."""
    rest = 0.0
    for k in range(60, 1, -1):
        rest = k / (x + rest)
    return rest


def _excess_at(z: float) -> float:
    """The excess; far below zero, differences of nearly equal numbers would lose digits."""
    return 1.0 / (_fraction(-z) - z) if z < -3.0 else z + _hazard.impl(z)


_VALUES: dict[str, Callable[[float], float]] = {
    "normal_log_probability": special.log_ndtr,
    "normal_hazard": lambda z: np.sqrt(2.0 / np.pi) / special.erfcx(-z / np.sqrt(2.0)),
    "normal_excess": _excess_at,
    "normal_variance_below": lambda z: (
        _excess_at(z) * (_fraction(-z) - _excess_at(z))
        if z < -3.0
        else 1.0 - _hazard.impl(z) * _excess_at(z)
    ),
}
