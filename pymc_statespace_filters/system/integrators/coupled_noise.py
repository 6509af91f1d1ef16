"""An integrator driven by the noise of finer steps, to compare two lengths of a step."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.tensor.variable import TensorVariable

from ..equations import Equation
from .protocol import Integrator, bound_to_states
from .substeps import Values


@dataclass(frozen=True)
class CoupledNoise:
    r"""An integrator that uses the normals of the one with ``factor`` times as many substeps.

    A Wiener process moves in a long substep by the sum of what it moves in the short ones, so the
    normal of a long substep is :math:`(q_1 + \dots + q_f) / \sqrt{f}`. That is standard normal:
    the law of a step is that of the integrator alone. Given the same normals, both integrators
    follow the same path of the Wiener process.
    """

    integrator: Integrator
    factor: int

    @property
    def dt(self) -> float:
        """Length of one step."""
        return self.integrator.dt

    @property
    def equations(self) -> tuple[Equation, ...]:
        """The user's functions."""
        return self.integrator.equations

    def bound_to(self, states: Sequence[str] | None) -> "CoupledNoise":
        """The same with indices in place of names of states."""
        return replace(self, integrator=bound_to_states(self.integrator, states))

    def linear_in_noise(self) -> "CoupledNoise":
        """The same with the integrator that is linear in its noise, if there is another one."""
        linear = getattr(self.integrator, "linear_in_noise", None)
        return self if linear is None else replace(self, integrator=linear())

    def noise_size(self, values: Values) -> int:
        """Number of standard normals of one step with finer substeps."""
        return self.factor * self.integrator.noise_size(values)

    def step(self, values: Values) -> TensorVariable:
        """The state one step later."""
        return self.integrator.step({**values, "q": self._combined(values)})

    def _combined(self, values: Values) -> TensorVariable:
        """The normals of the integrator, each from neighbours of its place."""
        q, n = values["q"], self.integrator.substep().noise_size(values)
        n_substeps = self.integrator.noise_size(values) // n
        sums = [
            sum(q[(j * self.factor + i) * n :][:n] for i in range(self.factor))
            for j in range(n_substeps)
        ]
        return pt.specify_shape(pt.concatenate(sums), (n * n_substeps,)) / np.sqrt(self.factor)

    def substep(self) -> Integrator:
        """That of the integrator, with noise of its own."""
        return self.integrator.substep()

    def refined(self) -> Integrator:
        """That of the integrator, with noise of its own."""
        return self.integrator.refined()

    def is_stable_at(self, eigenvalues: NDArray[np.complex128]) -> NDArray[np.bool_]:
        """Whether a substep of the integrator is stable."""
        return self.integrator.is_stable_at(eigenvalues)
