"""Local linearization: exact steps of the tangent of an equation, for stiff equations."""

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.tensor.variable import TensorVariable

from .step_series import root_of_covariance, step_matrices
from .substeps import SubstepIntegrator, Values, check_additive

N_TERMS = 9  # of the series for a 1/64 of a step
DOUBLINGS = 6


@dataclass(frozen=True)
class LocalLinearization(SubstepIntegrator):
    r"""Steps of :math:`dx = f(x)\,dt + G\,dW` that are exact for the tangent at their start.

    .. math::
        x_{k+1} = x_k + \int_0^h e^{J s} f(x_k)\, ds + q_k, \qquad
        q_k \sim N\Bigl(0, \int_0^h e^{J s} G G^T e^{J^T s}\, ds\Bigr), \qquad
        J = \frac{\partial f}{\partial x}(x_k)

    with ``h = dt / substeps``. Linear equations have no error. Without noise the order is 2, or 1
    if the drift depends on time; with additive noise the strong and the weak order are 1. A decay
    is followed up to rates of 200 per step, where explicit rules need steps shorter than its time
    constant. Each step computes a matrix exponential: up to four times the cost of `RungeKutta4`
    for two states, and growing as the cube of their number. It is meant for a few states.

    Parameters
    ----------
    drift : callable
        ``f(x, u, t, ...)`` as for `EulerMaruyama`; it is held at the start of a substep as a
        function of time.
    diffusion : callable or array_like, shape (n, m), optional
        ``G(u, t, ...)``, which must not depend on the state. None is an ordinary differential
        equation.
    dt : float
        Length of one step, in the time unit of the drift.
    substeps : int
        Number of steps of this kind within one step of length ``dt``; inputs are held.

    References
    ----------
    Jimenez, Shoji and Ozaki (1999), Simulation of stochastic differential equations through the
    local linearization method.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> def relaxation(x, mu):
    ...     return [x[1], mu * (1 - x[0] ** 2) * x[1] - x[0]]
    >>> psf.LocalLinearization(relaxation, dt=0.1).refined().substeps
    2
    """

    drift: Callable
    diffusion: Any = None
    _: KW_ONLY
    dt: float
    substeps: int = 1

    def noise_size(self, values: Values) -> int:
        """Number of standard normals of a step: one per state and substep."""
        diffusion = self._diffusion(values)
        check_additive(diffusion, values["x"], "LocalLinearization")
        return 0 if self.diffusion is None else self.substeps * values["x"].type.shape[0]

    def advance(self, now: Values, noise: TensorVariable, length: float) -> TensorVariable:
        """The state after a substep."""
        x, drift = now["x"], self._drift(now)
        spread = None
        if self.diffusion is not None:
            diffusion = self._diffusion(now)
            spread = diffusion @ diffusion.T
        _, moved, cov = step_matrices(
            _jacobian(drift, x), drift, spread, length, n_terms=N_TERMS, doublings=DOUBLINGS
        )
        return x + moved if cov is None else x + moved + root_of_covariance(cov) @ noise

    def is_stable_at(self, eigenvalues: NDArray[np.complex128]) -> NDArray[np.bool_]:
        """Whether the eigenvalues are finite: the step of a tangent is exact."""
        return np.isfinite(eigenvalues).all(axis=-1)


def _jacobian(drift: TensorVariable, x: TensorVariable) -> TensorVariable:
    n = x.type.shape[0]
    rows = [
        pytensor.grad(drift[i], x, disconnected_inputs="ignore", return_disconnected="zero")
        for i in range(n)
    ]
    return pt.specify_shape(pt.stack(rows), (n, n))
