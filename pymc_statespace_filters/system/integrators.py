"""From a stochastic differential equation to one step of the state."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system.equations import Equation, as_matrix, as_vector, read_equation


@dataclass(frozen=True)
class EulerMaruyama:
    r"""Euler-Maruyama steps of :math:`dx = f(x)\,dt + G(x)\,dW` in the sense of Ito.

    .. math:: x_{k+1} = x_k + h f(x_k) + \sqrt{h}\, G(x_k)\, q_k, \qquad q_k \sim N(0, I)

    with ``h = dt / substeps`` (thesis, Eq. 5.15). The functions are called with symbols, once.

    Parameters
    ----------
    drift : callable
        ``f(x, u, t, ...)``, one expression per state. Any of ``x`` (state), ``u`` (inputs) and
        ``t`` (time) may be asked for, by name; every other argument is a parameter.
    diffusion : callable or array_like, shape (n, m)
        ``G(x, u, t, ...)``, a row per state and a column per independent Wiener process, per
        square root of time. Correlated noises share columns.
    dt : float
        Length of one step, in the units of time of the drift.
    substeps : int
        Euler-Maruyama steps taken within one step of length ``dt``; inputs are held.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> def drift(x, alpha, beta):
    ...     return [alpha * x[0] + beta * x[0] ** 3]
    >>> psf.EulerMaruyama(drift, [[0.6]], dt=0.01).dt
    0.01
    """

    drift: Callable
    diffusion: Any
    dt: float
    substeps: int = 1

    def __post_init__(self) -> None:
        read_equation("drift", self.drift, "xut")
        if callable(self.diffusion):
            read_equation("diffusion", self.diffusion, "xut")
        else:
            object.__setattr__(self, "diffusion", _constant_diffusion(self.diffusion))
        if isinstance(self.substeps, bool) or not isinstance(self.substeps, int | np.integer):
            raise ModelError(f"substeps must be a whole number, got {self.substeps!r}")
        if self.substeps < 1:
            raise ModelError(f"substeps must be at least 1, got {self.substeps}")

    @property
    def equations(self) -> tuple[Equation, ...]:
        """The user's functions, in the order in which their parameters are listed."""
        drift = read_equation("drift", self.drift, "xut")
        if not callable(self.diffusion):
            return (drift,)
        return drift, read_equation("diffusion", self.diffusion, "xut")

    def noise_size(self, values: Mapping[str, TensorVariable]) -> int:
        """Number of standard normals that one step of length ``dt`` consumes."""
        return self.substeps * self._diffusion(values).type.shape[1]

    def step(self, values: Mapping[str, TensorVariable]) -> TensorVariable:
        """The state one step later, given the symbols ``x``, ``q``, ``u``, ``t`` and parameters."""
        state, time, length = values["x"], values["t"], self.dt / self.substeps
        n_noises = values["q"].type.shape[0] // self.substeps
        for i in range(self.substeps):
            now = {**values, "x": state, "t": time + i * length}
            noise = values["q"][i * n_noises : (i + 1) * n_noises]
            drift = as_vector("drift", self.equations[0](now), state.type.shape[0])
            shock = (np.sqrt(length) * self._diffusion(now)) @ noise
            state = state + length * drift + shock
        return state

    def _diffusion(self, values: Mapping[str, TensorVariable]) -> TensorVariable:
        n = values["x"].type.shape[0]
        if callable(self.diffusion):
            return as_matrix("diffusion", self.equations[1](values), rows=n)
        return as_matrix("diffusion", self.diffusion, rows=n)


def _constant_diffusion(value: Any) -> tuple[tuple[float, ...], ...]:
    try:
        matrix = np.asarray(value, dtype="float64")
    except (TypeError, ValueError):
        raise ModelError(
            f"diffusion must be a function or a matrix of numbers, got {value!r}"
        ) from None
    if matrix.ndim != 2 or not np.isfinite(matrix).all():
        raise ModelError(f"diffusion must be a finite matrix (states x noises), got {value!r}")
    return tuple(map(tuple, matrix.tolist()))
