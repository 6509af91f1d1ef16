"""The contract of an integrator: one step of the state from a differential equation."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pytensor.tensor.variable import TensorVariable

from ..equations import Equation


@runtime_checkable
class Integrator(Protocol):
    """The contract of an integrator, the ``transition`` of a `StateSpaceModel`.

    An integrator is immutable. A class fulfils the contract by having these members; it need not
    inherit from this one. Members that an integrator may have besides:

    * ``bound_to(states)``: the integrator with indices in place of names of states. ``states`` are
      the names that the system was given, or None.
    * ``noise_cov(values)``: the covariance of ``q``, a function of parameters alone, where ``q``
      are not standard normals.
    * ``linear_in_noise()``: an integrator with the same ``q``, linear in it, for filters of means
      and covariances, where a step is not.
    * ``at_length(length)``: an object whose ``step`` is as that of the integrator, of a length that
      is a symbol and at most ``dt``, for records at any times.
    * ``examined_step()``: another integrator of one substep, whose eigenvalues `is_stable_at` reads
      where those of ``substep().step`` do not tell.
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


def bound_to_states(transition: Any, states: Sequence[str] | None) -> Any:
    """The transition of a system whose states have these names; None if it was given no names."""
    bind = getattr(transition, "bound_to", None)
    return transition if bind is None else bind(states)
