"""A standard normal below a limit z, as operations: log of its probability, and what is left of it.

Each derivative is an expression of the other operations, so that all have derivatives of any order:
with the hazard h = φ / Φ, the excess e = z + h, the mean of z - Z given Z < z, and the variance v
of Z given Z < z,

    (log Φ)' = h,    h' = -h e,    e' = v,    v' = h (e**2 - v).

`compiler.numerics.quantiles.normal_below` is the machine code, found by the name ``machine_code``,
and accurate however far the limit is; ``impl`` is the slow form, for constants and interpreted
graphs.
"""

from typing import Any

import numpy as np
import pytensor.scalar as ps
from pytensor.tensor.elemwise import Elemwise
from scipy import special

_FAR = -3.0  # below which differences of nearly equal numbers would lose digits
_N_FRACTIONS = 60


def _double(*types: Any) -> tuple:
    return (ps.float64,)


class NormalBelow(ps.ScalarOp):
    """A function of the limit z."""

    nin = 1
    machine_code: str

    def __init__(self, output_types_preference: Any = None, name: str | None = None) -> None:
        super().__init__(_double, name or type(self).__name__)


class LogProbability(NormalBelow):
    """log Φ(z)."""

    machine_code = "normal_log_probability"

    def impl(self, z: float) -> float:  # noqa: D102
        return float(special.log_ndtr(z))

    def pullback(self, inputs: list, outputs: list, cotangents: list) -> list:  # noqa: D102
        return [cotangents[0] * _hazard(*inputs)]


class Hazard(NormalBelow):
    """φ(z) / Φ(z)."""

    machine_code = "normal_hazard"

    def impl(self, z: float) -> float:  # noqa: D102
        return float(np.sqrt(2.0 / np.pi) / special.erfcx(-z / np.sqrt(2.0)))

    def pullback(self, inputs: list, outputs: list, cotangents: list) -> list:  # noqa: D102
        return [-cotangents[0] * outputs[0] * _excess(*inputs)]


class Excess(NormalBelow):
    """z + φ(z) / Φ(z)."""

    machine_code = "normal_excess"

    def impl(self, z: float) -> float:  # noqa: D102
        return 1.0 / (_fraction(-z) - z) if z < _FAR else z + _hazard.impl(z)

    def pullback(self, inputs: list, outputs: list, cotangents: list) -> list:  # noqa: D102
        return [cotangents[0] * _variance(*inputs)]


class Variance(NormalBelow):
    """The variance of Z given Z < z."""

    machine_code = "normal_variance_below"

    def impl(self, z: float) -> float:  # noqa: D102
        excess = _excess.impl(z)
        if z < _FAR:
            return excess * (_fraction(-z) - excess)
        return 1.0 - _hazard.impl(z) * excess

    def pullback(self, inputs: list, outputs: list, cotangents: list) -> list:  # noqa: D102
        excess = _excess(*inputs)
        return [cotangents[0] * _hazard(*inputs) * (excess * excess - outputs[0])]


def _fraction(x: float) -> float:
    """Laplace's continued fraction 2 / (x + 3 / (x + ...)), which is 1 / e - x."""
    rest = 0.0
    for k in range(_N_FRACTIONS, 1, -1):
        rest = k / (x + rest)
    return rest


_hazard, _excess, _variance = Hazard(), Excess(), Variance()

log_probability = Elemwise(LogProbability())
hazard = Elemwise(_hazard)
excess = Elemwise(_excess)
variance = Elemwise(_variance)
