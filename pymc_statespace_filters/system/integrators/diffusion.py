"""The diffusion of a stochastic differential equation: a matrix of numbers or a function."""

from typing import Any

import numpy as np
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

from ...errors import ModelError


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
