"""Quantile functions of a standard normal: random variables as operations of a system's noise.

``PoissonQuantile()(z, mu)`` is the quantile of a Poisson law at the probability Φ(z), so it follows
that law if z is standard normal. Each operation is monotone in z and NaN where a parameter is
invalid. Counts are exact for all sizes of their parameters, gamma variables have a relative error
below 2e-9. None has a derivative that can be evaluated: counts jump.

`compiler.numerics.quantiles` is the machine code, found by the name ``machine_code``. ``impl`` is
the slow form, for constants and interpreted graphs. It has the digits of scipy, which are few in
the tails of means above 1e5: the relative error of such a probability reaches 1e-3.

Probabilities below those of 37 standard deviations are taken as theirs.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytensor.scalar as ps
from pytensor.tensor.elemwise import Elemwise
from scipy import special

FARTHEST = 37.0
"""Standard deviations beyond which a normal counts as if it were there."""


def _double(*types: Any) -> tuple:
    return (ps.float64,)


class Quantile(ps.ScalarOp):
    """A quantile function: a normal and the parameters of a law -> a number of that law.

    ``is_valid`` of the parameters says whether a law has them; ``quantile`` holds for valid ones,
    and a normal within 37 standard deviations.
    """

    machine_code: str
    is_valid: Callable[..., bool]
    quantile: Callable[..., float]

    def __init__(self, output_types_preference: Any = None, name: str | None = None) -> None:
        super().__init__(_double, name or type(self).__name__)

    def impl(self, z: float, *parameters: float) -> float:
        """The quantile at Φ(z); NaN for parameters that are not of the law."""
        if not (z == z and self.is_valid(*parameters)):
            return np.nan
        with np.errstate(all="ignore"):
            return float(self.quantile(float(np.clip(z, -FARTHEST, FARTHEST)), *parameters))

    def pullback(self, inputs: list, outputs: list, cotangents: list) -> list:
        """`NoDerivative`, which depends on all inputs and cannot be compiled."""
        (cotangent,) = cotangents
        return [cotangent * NoDerivative(self, i)(*inputs) for i in range(len(inputs))]


class NoDerivative(ps.ScalarOp):
    """The missing derivative of a quantile by its argument i.

    What a system is like can be read off symbolic derivatives, so there must be one; but machine
    code of it is refused.
    """

    def __init__(self, quantile: Quantile, i: int) -> None:
        super().__init__(_double, f"the derivative of {quantile} by its argument {i}")
        self.quantile, self.i = quantile, i
        self.nin = quantile.nin

    def __eq__(self, other: object) -> bool:
        return isinstance(other, NoDerivative) and self.name == other.name

    def __hash__(self) -> int:
        return hash((type(self), self.name))

    def impl(self, *arguments: float) -> float:  # noqa: D102
        return np.nan

    def pullback(self, inputs: list, outputs: list, cotangents: list) -> list:  # noqa: D102
        (cotangent,) = cotangents
        return [cotangent * self(*inputs) for _ in inputs]


class PoissonQuantile(Quantile):
    """``(z, mu)``: a Poisson number of mean mu >= 0."""

    nin, machine_code = 2, "poisson_quantile"

    def is_valid(self, mu: float) -> bool:  # noqa: D102
        return 0.0 <= mu < np.inf

    def quantile(self, z: float, mu: float) -> float:  # noqa: D102
        def reached(k: float) -> bool:
            if z <= 0.0:
                return special.gammaincc(k + 1.0, mu) >= special.ndtr(z)
            return special.gammainc(k + 1.0, mu) <= special.ndtr(-z)

        guess = mu + z * np.sqrt(mu) + (z * z - 1.0) / 6.0
        return _smallest(reached, guess, np.inf)


class BinomialQuantile(Quantile):
    """``(z, n, p)``: the number of successes in n trials of probability p; n must be whole."""

    nin, machine_code = 3, "binomial_quantile"

    def is_valid(self, n: float, p: float) -> bool:  # noqa: D102
        return 0.0 <= n < np.inf and np.floor(n) == n and 0.0 <= p <= 1.0

    def quantile(self, z: float, n: float, p: float) -> float:  # noqa: D102
        if n == 0.0 or p in (0.0, 1.0):
            return n * p

        def reached(k: float) -> bool:
            if k >= n:
                return True
            if z <= 0.0:
                return special.betaincc(k + 1.0, n - k, p) >= special.ndtr(z)
            return special.betainc(k + 1.0, n - k, p) <= special.ndtr(-z)

        guess = n * p + z * np.sqrt(n * p * (1.0 - p))
        return _smallest(reached, min(guess, n), n)


class BernoulliQuantile(Quantile):
    """``(z, p)``: 1 with probability p, else 0."""

    nin, machine_code = 2, "bernoulli_quantile"

    def is_valid(self, p: float) -> bool:  # noqa: D102
        return 0.0 <= p <= 1.0

    def quantile(self, z: float, p: float) -> float:  # noqa: D102
        return 1.0 if p == 1.0 or special.ndtr(-z) < p else 0.0


class GammaQuantile(Quantile):
    """``(z, shape, scale)``: a gamma variable of mean shape * scale."""

    nin, machine_code = 3, "gamma_quantile"

    def is_valid(self, shape: float, scale: float) -> bool:  # noqa: D102
        return 0.0 < shape < np.inf and 0.0 <= scale < np.inf

    def quantile(self, z: float, shape: float, scale: float) -> float:  # noqa: D102
        if z > 0.0:
            return scale * special.gammainccinv(shape, special.ndtr(-z))
        return scale * special.gammaincinv(shape, special.ndtr(z))


class NormalProbability(Quantile):
    """``(z,)``: Φ(z), a uniform number in (0, 1)."""

    nin, machine_code = 1, "normal_probability"

    def is_valid(self) -> bool:  # noqa: D102
        return True

    def quantile(self, z: float) -> float:  # noqa: D102
        return special.ndtr(z)


def _smallest(reached: Callable[[float], bool], guess: float, largest: float) -> float:
    """The smallest whole number, from 0 to ``largest``, at which a growing condition holds."""
    above = max(np.floor(guess), 0.0)
    step = 1.0
    while not reached(above):
        above, step = min(above + step, largest), 2.0 * step
    below, step = above - 1.0, 1.0
    while below >= 0.0 and reached(below):
        above, below, step = below, below - step, 2.0 * step
    below = max(below, -1.0)
    while above - below > 1.0:
        middle = np.floor(0.5 * (above + below))
        below, above = (below, middle) if reached(middle) else (middle, above)
    return above


poisson_quantile = Elemwise(PoissonQuantile())
binomial_quantile = Elemwise(BinomialQuantile())
bernoulli_quantile = Elemwise(BernoulliQuantile())
gamma_quantile = Elemwise(GammaQuantile())
normal_probability = Elemwise(NormalProbability())
