"""What all integrators have in common that repeat a substep of dx = f dt + G dW.

One driven by the noise of finer steps compares two lengths of a step.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

from ...errors import ModelError
from ..checks import check_count
from ..equations import Equation, as_matrix, as_vector, read_equation
from .protocol import Integrator, bound_to_states

MOST_SUBSTEPS = 1000  # 400 take most of a minute to compile
Values = Mapping[str, TensorVariable]


def constant_diffusion(value: Any) -> tuple[tuple[float, ...], ...]:
    """A matrix of numbers (states x noises), checked, as nested tuples."""
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


def check_additive(diffusion: TensorVariable, x: TensorVariable, integrator: str) -> None:
    """Raise if a traced diffusion is a function of the state."""
    if x in ancestors([diffusion]):
        raise ModelError(
            f"diffusion must not depend on the state x in {integrator}, which takes additive noise "
            "only; use Milstein or EulerMaruyama for noise that depends on the state"
        )


class SubstepIntegrator:
    """An integrator that divides a step into substeps of one kind, `advance`.

    Subclasses are frozen dataclasses with the fields below.
    """

    drift: Callable
    diffusion: Any
    dt: float
    substeps: int

    def __post_init__(self) -> None:
        if self.diffusion is not None and not callable(self.diffusion):
            object.__setattr__(self, "diffusion", constant_diffusion(self.diffusion))
        _ = self.equations  # checks the functions
        if check_count("substeps", self.substeps, 1) > MOST_SUBSTEPS:
            raise ModelError(
                f"substeps must be at most {MOST_SUBSTEPS}, as the code of each is compiled, got "
                f"{self.substeps}: take a smaller dt"
            )

    def advance(self, now: Values, noise: TensorVariable, length: float) -> TensorVariable:
        """The state after a substep, from the values at its start and its standard normals."""
        raise NotImplementedError

    @property
    def equations(self) -> tuple[Equation, ...]:
        """The user's functions, in the order in which their parameters are listed."""
        drift = read_equation("drift", self.drift, "xut")
        if not callable(self.diffusion):
            return (drift,)
        return drift, read_equation("diffusion", self.diffusion, "xut")

    def noise_size(self, values: Values) -> int:
        """Number of standard normals that one step of length ``dt`` uses."""
        return self.substeps * self._diffusion(values).type.shape[1]

    def step(self, values: Values) -> TensorVariable:
        """The state one step later, given the symbols ``x``, ``q``, ``u``, ``t`` and parameters."""
        state, time, length = values["x"], values["t"], self.dt / self.substeps
        n_noises = values["q"].type.shape[0] // self.substeps
        for i in range(self.substeps):
            now = {**values, "x": state, "t": time + i * length}
            noise = values["q"][i * n_noises : (i + 1) * n_noises]
            state = self.advance(now, noise, length)
        return state

    def substep(self) -> Self:
        """One step of the same kind, of length ``dt / substeps``."""
        return self._replace(dt=self.dt / self.substeps, substeps=1)

    def at_length(self, length: TensorVariable) -> Self:
        """The same integrator with steps of this length, a symbol."""
        return self._replace(dt=length)

    def refined(self) -> Self:
        """The same integrator with twice as many substeps."""
        return self._replace(substeps=2 * self.substeps)

    def is_stable_at(self, eigenvalues: NDArray[np.complex128]) -> NDArray[np.bool_]:
        """Whether no eigenvalue has a negative real part.

        The equation multiplies a small deviation by exp(a h), an Euler-Maruyama step by 1 + a h:
        where that is negative, the step overshoots. A semi-implicit step turns the phase of an
        oscillator without damping by an angle whose cosine is 1 - (w h)^2 / 2. It loses its
        stability at w h = 2, where the angle is half a turn; beyond a quarter of a turn, w h = 1.4,
        it does not follow the oscillation.
        """
        return eigenvalues.real.min(axis=-1) >= 0

    def _replace(self, **changes: Any) -> Self:
        return replace(self, **changes)  # type: ignore[type-var]

    def _drift(self, now: Values) -> TensorVariable:
        return as_vector("drift", self.equations[0](now), now["x"].type.shape[0])

    def _diffusion(self, now: Values) -> TensorVariable:
        """The matrix G (n, m), without columns where the equation has no noise."""
        n = now["x"].type.shape[0]
        if self.diffusion is None:
            return pt.zeros((n, 0))
        if callable(self.diffusion):
            return as_matrix("diffusion", self.equations[1](now), rows=n)
        return as_matrix("diffusion", self.diffusion, rows=n)

    def _shock(self, now: Values, noise: TensorVariable, length: float) -> TensorVariable:
        """The noise sqrt(h) G q of a substep."""
        return (root_of(length) * self._diffusion(now)) @ noise


def root_of(length: Any) -> Any:
    """The square root of a length, a number or a symbol."""
    return pt.sqrt(length) if isinstance(length, Variable) else np.sqrt(length)


def check_needed(diffusion: Any, integrator: str) -> None:
    """Raise if an integrator that needs a diffusion has none."""
    if diffusion is None:
        raise ModelError(
            f"diffusion must be a function or a matrix of numbers in {integrator}, got None; "
            "RungeKutta4, SemiImplicitEuler and LocalLinearization treat equations without noise"
        )


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

    def at_length(self, length: TensorVariable) -> "CoupledNoise":
        """The same with steps of this length, a symbol."""
        return replace(self, integrator=self.integrator.at_length(length))  # type: ignore[attr-defined]

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
