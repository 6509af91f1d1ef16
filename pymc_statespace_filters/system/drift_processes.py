"""How a drifting parameter moves on its scale: as a random walk, or returning to its start."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import pytensor.tensor as pt
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from .checks import check_count
from .integrators.substeps import root_of
from .links import Link, read_scale


@dataclass(frozen=True)
class DriftProcess:
    """What all processes of drift have: a scale, and how many steps a value is held."""

    _: KW_ONLY
    scale: Any = "identity"
    every: int = 1

    parameters: ClassVar[tuple[str, ...]] = ("strength",)

    def __post_init__(self) -> None:
        if isinstance(self.scale, list):  # a process is hashable
            object.__setattr__(self, "scale", tuple(self.scale))
        read_scale(self.scale)
        object.__setattr__(self, "every", check_count("every", self.every, 1))

    @property
    def link(self) -> Link:
        """The scale."""
        return read_scale(self.scale)

    def move(
        self,
        now: TensorVariable,
        start: TensorVariable,
        noise: TensorVariable,
        length: Any,
        values: Sequence[TensorVariable],
    ) -> TensorVariable:
        """What a time ``length`` and a standard normal ``noise`` add to the number on the scale.

        ``start`` is the number at the start, and ``values`` are those of ``parameters``.
        """
        returned, spread = self._step(length, *values)
        return returned * (now - start) + spread * noise

    def _step(self, length: Any, *values: TensorVariable) -> tuple[Any, TensorVariable]:
        """What a step adds of the distance from the start, and its standard deviation."""
        raise NotImplementedError


@dataclass(frozen=True)
class RandomWalk(DriftProcess):
    r"""A drifting parameter that moves by independent normal steps, see `drifting`.

    .. math::
        z_{k+1} = z_k + s \sqrt{h}\, q_k, \qquad q_k \sim N(0, 1), \qquad z_0 = \ell(\theta)

    with the parameter :math:`\theta` at the start, its scale :math:`\ell`, the length ``h`` of a
    step and the strength ``s``, a parameter: the standard deviation on the scale per square root of
    time.

    Parameters
    ----------
    scale : {"identity", "log"} or tuple ("logit", low, high)
        The parameter moves freely, stays positive, or stays between bounds.
    every : int
        The parameter is held for so many steps of the system, and moves at their end by the noise
        of their length. At times off the grid of steps it is held for ``every * dt`` units of time.

    Raises
    ------
    ModelError
        If an argument is wrong.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.RandomWalk(scale="log", every=7)
    RandomWalk(scale='log', every=7)
    """

    def _step(self, length: Any, *values: TensorVariable) -> tuple[Any, TensorVariable]:
        (strength,) = values
        return 0.0, strength * root_of(length)


@dataclass(frozen=True)
class OrnsteinUhlenbeck(DriftProcess):
    r"""A drifting parameter that returns to its value at the start, see `drifting`.

    .. math::
        dz = -r (z - z_0)\, dt + s\, dW, \qquad z_0 = \ell(\theta)

    with the parameter :math:`\theta` at the start and its scale :math:`\ell`, by exact steps. The
    strength ``s`` and the rate ``r > 0`` are parameters; far from the start of the record the
    standard deviation on the scale is :math:`s / \sqrt{2 r}`.

    Parameters
    ----------
    scale : {"identity", "log"} or tuple ("logit", low, high)
        The parameter moves freely, stays positive, or stays between bounds.
    every : int
        As in `RandomWalk`.

    Raises
    ------
    ModelError
        If an argument is wrong.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.OrnsteinUhlenbeck(scale=("logit", 0, 1))
    OrnsteinUhlenbeck(scale=('logit', 0, 1), every=1)
    """

    parameters: ClassVar[tuple[str, ...]] = ("strength", "rate")

    def _step(self, length: Any, *values: TensorVariable) -> tuple[Any, TensorVariable]:
        strength, rate = values
        is_symbol = isinstance(length, Variable)
        some = pt.switch(pt.gt(length, 0.0), length, 1.0) if is_symbol else length
        spread = pt.sqrt(-pt.expm1(-2.0 * rate * some) / (2.0 * rate))
        if is_symbol:  # the root has no derivative at the length zero
            spread = pt.switch(pt.gt(length, 0.0), spread, 0.0)
        return pt.expm1(-rate * length), strength * spread
