"""Rest points of a system, by Newton's method."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.tensor.variable import TensorVariable

from ..compiler.lowering.symbols import call, jacobian_of, symbols_of
from ..compiler.native.rows import interpreted_at_points
from ..errors import ModelError
from ..system.equations import as_vector
from ..system.model import StateSpaceModel
from ..system.signature import parameter_symbols

MAX_ITERATIONS = 100
MAX_HALVINGS = 30  # of a step of Newton's method that does not lead closer
STEP_TOLERANCE = 1e-12
VALUE_TOLERANCE = 1e-8

Array = NDArray[np.float64]


class VectorField(NamedTuple):
    """What is zero at a rest point: the drift, or the step less the state before it.

    ``value(theta, x)`` (m, r), ``jacobian(theta, x)`` (m, r, n) and ``start(theta)`` (m, n), the
    initial mean, take m points; inputs, time and noise are zero. ``resting`` are the r states that
    can come to rest: all but accumulators, which sum.
    """

    value: Callable[[Array, Array], Array]
    jacobian: Callable[[Array, Array], Array]
    start: Callable[[Array], Array]
    resting: list[int]
    is_drift: bool
    dt: float


def vector_field(system: StateSpaceModel) -> VectorField:
    """The vector field of a system, from its drift if its integrator has one."""
    symbols = symbols_of(system)
    theta, x = symbols["theta"], symbols["x"]
    drift = _drift(system, theta, x)
    if drift is None:
        step = system.with_gaussian_steps.equations.transition
        value = call(step, system, {"theta": theta, "x": x}) - x
    else:
        value = drift
    start = call(system.equations.initial_mean, system, {"theta": theta})
    resting = [i for i, name in enumerate(system.states) if name not in system.accumulators]
    value = value[resting]
    return VectorField(
        interpreted_at_points([theta, x], value),
        interpreted_at_points([theta, x], jacobian_of(value, x)),
        interpreted_at_points([theta], start),
        resting,
        drift is not None,
        system.dt,
    )


def _drift(
    system: StateSpaceModel, theta: TensorVariable, x: TensorVariable
) -> TensorVariable | None:
    integrator = system.integrator
    written = getattr(integrator, "drift", None)
    if integrator is None or written is None:
        return None
    (equation,) = (e for e in integrator.equations if e.function is written)
    values = parameter_symbols(theta, system.parameters, system.parameter_shapes)
    given = {"x": x, "u": pt.zeros((system.n_inputs,)), "t": pt.zeros(())}
    return as_vector("drift", equation(values | given), system.n)


def rest_points(system: StateSpaceModel, field: VectorField, theta: Array, several: bool) -> Array:
    """A rest point (m, n) for every row of parameters, from the initial mean on.

    If there are ``several``, the first row is the median of the others.
    """
    x = field.start(theta)
    with np.errstate(all="ignore"):
        value, jacobian = field.value(theta, x), field.jacobian(theta, x)
        for _ in range(MAX_ITERATIONS):
            step = _newton_step(jacobian, value)
            if (_norm(step) <= STEP_TOLERANCE * (1 + _norm(x))).all():
                break
            before, (x, value) = x, _move(field, theta, x, value, step)
            if (x == before).all():  # nothing leads closer
                break
            jacobian = field.jacobian(theta, x)
        scale = np.abs(jacobian).max(axis=(1, 2)) * (1 + _norm(x))
        found = (_norm(value) <= VALUE_TOLERANCE * scale) | (_norm(value) == 0)
    if not found.all():
        start = field.start(theta)[~found][0].tolist()
        raise ModelError(
            f"the system must come to rest somewhere, got no rest point{_where(found, several)} by "
            f"Newton's method from the initial mean {start} with zero inputs: give at=, the state "
            "about which to linearise"
        )
    return x


def _where(found: NDArray[np.bool_], several: bool) -> str:
    if not several:
        return ""
    n_failed = (~found[1:]).sum()
    if not n_failed:
        return " at the median of the parameters"
    return f" at {n_failed} of {len(found) - 1} draws"


def _newton_step(jacobian: Array, value: Array) -> Array:
    """The least step that solves the linearised equations best; 0 where they are not finite."""
    finite = np.isfinite(jacobian).all(axis=(1, 2)) & np.isfinite(value).all(axis=1)
    step = np.zeros(jacobian.shape[::2])
    # The pseudoinverse, because rest points may fill a line: a position that no spring holds.
    step[finite] = -(np.linalg.pinv(jacobian[finite]) @ value[finite, :, None])[..., 0]
    return step


def _move(
    field: VectorField, theta: Array, x: Array, value: Array, step: Array
) -> tuple[Array, Array]:
    """The points after the longest of the steps, halved if need be, that lowers the value."""
    length = np.ones((len(x), 1))
    for _ in range(MAX_HALVINGS):
        moved = x + length * step
        new = field.value(theta, moved)
        worse = ~(_norm(new) < _norm(value)) & (_norm(step) > 0)
        if not worse.any():
            return moved, new
        length[worse] /= 2
    stay = worse[:, None]
    return np.where(stay, x, moved), np.where(stay, value, new)


def _norm(vectors: Array) -> Array:
    return np.linalg.norm(vectors, axis=1)
