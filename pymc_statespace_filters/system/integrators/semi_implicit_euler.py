"""Semi-implicit (symplectic) Euler steps, for mechanics."""

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, Self

import numpy as np
import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from ...errors import ModelError
from ..checks import is_integer
from .substeps import SubstepIntegrator, Values


@dataclass(frozen=True)
class SemiImplicitEuler(SubstepIntegrator):
    r"""Semi-implicit Euler steps of :math:`dx = f(x)\,dt + G(x)\,dW` (Ito) for mechanics.

    The velocities ``v`` move first, by the drift at the old state; all other states ``p`` then move
    by the drift at the new velocities,

    .. math::
        v_{k+1} &= v_k + h f_v(p_k, v_k) + \sqrt{h}\, G_v(p_k, v_k)\, q_k, \\
        p_{k+1} &= p_k + h f_p(p_k, v_{k+1}) + \sqrt{h}\, G_p(p_k, v_k)\, q_k

    with ``h = dt / substeps``. An oscillator without damping then neither gains nor loses energy in
    the long run, where `EulerMaruyama` gains it at every step. The orders are those of
    `EulerMaruyama`: weak 1, strong 1/2, with additive noise 1; without noise 1.

    Parameters
    ----------
    drift : callable
        ``f(x, u, t, ...)`` as for `EulerMaruyama`, such as `second_order` makes.
    diffusion : callable or array_like, shape (n, m), optional
        ``G(x, u, t, ...)`` as for `EulerMaruyama`; None is an equation without noise.
    dt : float
        Length of one step, in the time unit of the drift.
    velocities : sequence of int or str
        The states that are velocities, by index, or by name where the system has ``states``.
    substeps : int
        Number of semi-implicit Euler steps within one step of length ``dt``; inputs are held.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> def oscillator(x, w):
    ...     return [x[1], -w**2 * x[0]]
    >>> psf.SemiImplicitEuler(oscillator, dt=0.1, velocities=[1]).velocities
    (1,)
    """

    drift: Callable
    diffusion: Any = None
    _: KW_ONLY
    dt: float
    velocities: Sequence[int | str]
    substeps: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "velocities", _read_velocities(self.velocities))

    def bound_to(self, states: Sequence[str] | None) -> Self:
        """The same integrator with indices in place of names of states."""
        return self._replace(velocities=tuple(_index(v, states) for v in self.velocities))

    def advance(self, now: Values, noise: TensorVariable, length: float) -> TensorVariable:
        """The state after a substep."""
        x = now["x"]
        velocities = self._velocity_indices(x.type.shape[0])
        is_velocity = np.isin(np.arange(x.type.shape[0]), velocities)
        shock = 0.0 if self.diffusion is None else self._shock(now, noise, length)
        pushed = x + length * self._drift(now) + shock
        between = pt.stack([pushed[i] if new else x[i] for i, new in enumerate(is_velocity)])
        moved = x + length * self._drift({**now, "x": between}) + shock
        return pt.stack([pushed[i] if new else moved[i] for i, new in enumerate(is_velocity)])

    def _velocity_indices(self, n: int) -> list[int]:
        indices = [_index(v, None) for v in self.velocities]
        outside = [i for i in indices if not -n <= i < n]
        if outside:
            raise ModelError(
                f"velocities must be indices of the {n} states, 0 to {n - 1}, got {outside[0]}"
            )
        indices = [i % n for i in indices]
        if len(set(indices)) < len(indices):
            raise ModelError(f"velocities must name every state once, got {list(self.velocities)}")
        if len(indices) == n:
            raise ModelError(
                f"velocities must leave a state that is a position, got all {n} states; use "
                "EulerMaruyama for an equation without positions"
            )
        return indices


def _read_velocities(velocities: Any) -> tuple[int | str, ...]:
    given = [velocities] if isinstance(velocities, str) or is_integer(velocities) else velocities
    try:
        entries = tuple(given)
    except TypeError:
        entries = ()
    if not entries or not all(is_integer(v) or isinstance(v, str) for v in entries):
        raise ModelError(
            "velocities must be indices or names of the states that are velocities, "
            f"got {velocities!r}"
        )
    return tuple(v if isinstance(v, str) else int(v) for v in entries)


def _index(velocity: int | str, states: Sequence[str] | None) -> int:
    if not isinstance(velocity, str):
        return velocity
    if states is None:
        raise ModelError(
            f"velocities must be indices where the system has no names of states, got "
            f"{velocity!r}; give the system states=[...]"
        )
    if velocity not in states:
        raise ModelError(
            f"velocities must be names of states, {list(states)}, or indices, got {velocity!r}"
        )
    return list(states).index(velocity)
