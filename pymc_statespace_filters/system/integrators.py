"""Integrators: one step of the state from a stochastic differential equation."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system.checks import check_count
from pymc_statespace_filters.system.equations import Equation, as_matrix, as_vector, read_equation


@runtime_checkable
class Integrator(Protocol):
    """The contract of an integrator, the ``transition`` of a `StateSpaceModel`.

    An integrator is immutable. A class fulfils the contract by having these members; it need not
    inherit from this one.
    """

    @property
    def dt(self) -> float:
        """Length of one step."""
        ...

    @property
    def equations(self) -> tuple[Equation, ...]:
        """The user's functions, in the order in which their parameters are listed."""
        ...

    def noise_size(self, values: Mapping[str, TensorVariable]) -> int:
        """Number of independent standard normals ``q`` that one step uses.

        ``values`` holds the symbols ``x``, ``u`` and ``t`` and the parameters by name.
        """
        ...

    def step(self, values: Mapping[str, TensorVariable]) -> TensorVariable:
        """The state one step later; ``values`` holds ``q`` too. Called once, with symbols."""
        ...

    def substep(self) -> "Integrator":
        """The integrator of the shortest step that this one repeats, itself if it repeats none.

        Its ``dt`` divides this one's.
        """
        ...

    def refined(self) -> "Integrator":
        """An integrator of the same ``dt`` and equations that takes substeps half as long."""
        ...

    def is_stable_at(self, eigenvalues: NDArray[np.complex128]) -> NDArray[np.bool_]:
        """Whether a step follows its equation instead of overshooting, decided at many states.

        Parameters
        ----------
        eigenvalues : ndarray of complex, shape (..., n)
            Eigenvalues of the Jacobian of ``substep().step`` by the state, without noise. NaN where
            the Jacobian is not finite, which is not stable.

        Returns
        -------
        ndarray of bool, shape (...)
        """
        ...


@dataclass(frozen=True)
class EulerMaruyama:
    r"""Euler-Maruyama steps of :math:`dx = f(x)\,dt + G(x)\,dW` (Ito).

    .. math:: x_{k+1} = x_k + h f(x_k) + \sqrt{h}\, G(x_k)\, q_k, \qquad q_k \sim N(0, I)

    with ``h = dt / substeps`` (thesis, Eq. 5.15). The functions are called once, with symbols.

    Parameters
    ----------
    drift : callable
        ``f(x, u, t, ...)``, one expression per state, for one state a scalar. ``x`` (state), ``u``
        (inputs) and ``t`` (time) are passed by name if they are arguments; every other argument is
        a parameter.
    diffusion : callable or array_like, shape (n, m)
        ``G(x, u, t, ...)``, one row per state and one column per independent Wiener process, per
        square root of time. Correlated noises share columns. One state and one noise: a scalar.
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
    diffusion: Any
    dt: float
    substeps: int = 1

    def __post_init__(self) -> None:
        _ = self.equations  # checks the functions
        if not callable(self.diffusion):
            object.__setattr__(self, "diffusion", _constant_diffusion(self.diffusion))
        check_count("substeps", self.substeps, 1)

    @property
    def equations(self) -> tuple[Equation, ...]:
        """The user's functions, in the order in which their parameters are listed."""
        drift = read_equation("drift", self.drift, "xut")
        if not callable(self.diffusion):
            return (drift,)
        return drift, read_equation("diffusion", self.diffusion, "xut")

    def noise_size(self, values: Mapping[str, TensorVariable]) -> int:
        """Number of standard normals that one step of length ``dt`` uses."""
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

    def substep(self) -> Self:
        """One Euler-Maruyama step of length ``dt / substeps``."""
        return replace(self, dt=self.dt / self.substeps, substeps=1)

    def refined(self) -> Self:
        """The same integrator with twice as many substeps."""
        return replace(self, substeps=2 * self.substeps)

    def is_stable_at(self, eigenvalues: NDArray[np.complex128]) -> NDArray[np.bool_]:
        """Whether no eigenvalue has a negative real part.

        The equation multiplies a small deviation by exp(a h), an Euler-Maruyama step by 1 + a h:
        where that is negative, the step overshoots.
        """
        return eigenvalues.real.min(axis=-1) >= 0

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
    if matrix.ndim == 0:  # one state, one noise
        matrix = matrix.reshape(1, 1)
    if matrix.ndim != 2 or not np.isfinite(matrix).all():
        raise ModelError(f"diffusion must be a finite matrix (states x noises), got {value!r}")
    return tuple(map(tuple, matrix.tolist()))
