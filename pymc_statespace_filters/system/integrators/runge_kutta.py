"""Classical Runge-Kutta steps, for equations without noise or with additive noise."""

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.tensor.variable import TensorVariable

from .euler_maruyama import EulerMaruyama
from .substeps import SubstepIntegrator, Values, check_additive

LARGEST_Z = 1.6


@dataclass(frozen=True)
class RungeKutta4(SubstepIntegrator):
    r"""Classical Runge-Kutta steps of :math:`dx = f(x)\,dt + G\,dW`, with additive noise or none.

    .. math::
        x_{k+1} &= x_k + \tfrac{h}{6}(a + 2 b + 2 c + d) + \sqrt{h}\, G(t_k)\, q_k, \\
        a &= f(x_k, t_k), \qquad b = f(x_k + \tfrac{h}{2} a,\, t_k + \tfrac{h}{2}), \\
        c &= f(x_k + \tfrac{h}{2} b,\, t_k + \tfrac{h}{2}), \qquad d = f(x_k + h c,\, t_k + h)

    with ``h = dt / substeps``. Without noise the order is 4. With noise the error of the drift is
    still of order 4, but the noise enters at the end of a substep: the strong and the weak order
    are 1. Where the noise is small, the error in all is small too.

    Parameters
    ----------
    drift : callable
        ``f(x, u, t, ...)`` as for `EulerMaruyama`. Inputs are held over a step, time is not.
    diffusion : callable or array_like, shape (n, m), optional
        ``G(u, t, ...)``, which must not depend on the state. None is an ordinary differential
        equation.
    dt : float
        Length of one step, in the time unit of the drift.
    substeps : int
        Number of Runge-Kutta steps within one step of length ``dt``.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> def pendulum(x, w):
    ...     return [x[1], -w**2 * x[0]]
    >>> psf.RungeKutta4(pendulum, dt=0.1).refined().substeps
    2
    """

    drift: Callable
    diffusion: Any = None
    _: KW_ONLY
    dt: float
    substeps: int = 1

    def noise_size(self, values: Values) -> int:
        """Number of standard normals that one step of length ``dt`` uses; checks the diffusion."""
        check_additive(self._diffusion(values), values["x"], "RungeKutta4")
        return super().noise_size(values)

    def advance(self, now: Values, noise: TensorVariable, length: float) -> TensorVariable:
        """The state after a substep."""
        x, t, h = now["x"], now["t"], length
        a = self._drift(now)
        b = self._drift({**now, "x": x + h / 2 * a, "t": t + h / 2})
        c = self._drift({**now, "x": x + h / 2 * b, "t": t + h / 2})
        d = self._drift({**now, "x": x + h * c, "t": t + h})
        moved = x + h / 6 * (a + 2 * b + 2 * c + d)
        return moved if self.diffusion is None else moved + self._shock(now, noise, length)

    def examined_step(self) -> EulerMaruyama:
        """The Euler step of a substep, with the eigenvalues 1 + z where J has z / h.

        Those of the Runge-Kutta step, R(z) = 1 + z + z^2/2 + z^3/6 + z^4/24, do not tell z: each
        belongs to a slow decay, and to a fast one near the limit of stability.
        """
        return EulerMaruyama(self.drift, _no_noise, dt=self.dt / self.substeps)

    def is_stable_at(self, eigenvalues: NDArray[np.complex128]) -> NDArray[np.bool_]:
        """Whether no eigenvalue 1 + z of `examined_step` has an absolute z above 1.6.

        Up to there R(z) follows exp(z) to within a tenth. Beyond it the step of a decay gets longer
        again as the decay gets faster; for z < -2.79, or beyond 2.83 i, deviations grow.
        """
        return (np.abs(eigenvalues - 1.0) <= LARGEST_Z).all(axis=-1)


def _no_noise(x: TensorVariable) -> TensorVariable:
    return pt.zeros((x.type.shape[0], 1))
