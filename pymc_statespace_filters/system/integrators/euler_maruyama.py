"""Euler-Maruyama steps, thesis, Eq. 5.15."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pytensor.tensor.variable import TensorVariable

from .substeps import SubstepIntegrator, Values, check_needed


@dataclass(frozen=True)
class EulerMaruyama(SubstepIntegrator):
    r"""Euler-Maruyama steps of :math:`dx = f(x)\,dt + G(x)\,dW` (Ito).

    .. math:: x_{k+1} = x_k + h f(x_k) + \sqrt{h}\, G(x_k)\, q_k, \qquad q_k \sim N(0, I)

    with ``h = dt / substeps`` (thesis, Eq. 5.15). The strong order is 1/2, with additive noise 1;
    the weak order is 1. The functions are called once, with symbols.

    Parameters
    ----------
    drift : callable
        ``f(x, u, t, ...)``, one expression per state, for one state a scalar. ``x`` (state), ``u``
        (inputs) and ``t`` (time) are passed by name if they are arguments; every other argument is
        a parameter.
    diffusion : callable or array_like, shape (n, m)
        ``G(x, u, t, ...)``, one row per state and one column per independent Wiener process, per
        square root of time. Correlated noises share columns. One state and one noise: a scalar.
        It must be given: other integrators treat equations without noise.
    dt : float
        Length of one step, in the time unit of the drift.
    substeps : int
        Number of Euler-Maruyama steps within one step of length ``dt``; inputs are held.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> def drift(x, alpha, beta):
    ...     return [alpha * x[0] + beta * x[0] ** 3]
    >>> psf.EulerMaruyama(drift, [[0.6]], dt=0.01).dt
    0.01
    """

    drift: Callable
    diffusion: Any = None
    dt: float = None  # type: ignore[assignment]  # behind a default, but it must be given
    substeps: int = 1

    def __post_init__(self) -> None:
        check_needed(self.diffusion, "EulerMaruyama")
        super().__post_init__()

    def advance(self, now: Values, noise: TensorVariable, length: float) -> TensorVariable:
        """The state after a substep."""
        return now["x"] + length * self._drift(now) + self._shock(now, noise, length)
