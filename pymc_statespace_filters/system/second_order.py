"""Equations of motion of second order, as a drift of positions and velocities."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .checks import shortened
from .equations import Equation, as_matrix, as_symbol, as_vector, read_equation
from .signature import parameter_names


def second_order(
    mass: Any, damping: Any, stiffness: Any, force: Callable | None = None
) -> Callable:
    r"""The drift of a mechanical system, for the ``drift`` of an integrator.

    .. math:: M \ddot q + D \dot q + K q + N(q, \dot q, u, t) = u

    The 2 n states are the n positions ``q``, then the n velocities. Parameters of all functions
    become parameters of the system, with their names and defaults.

    Parameters
    ----------
    mass, damping, stiffness : array_like, shape (n, n), or callable
        Matrices ``M``, ``D`` and ``K``: numbers, or a function of parameters that returns nested
        lists or a symbolic matrix. A single number stands for a matrix of one entry.
    force : callable, optional
        ``N(q, v, u, t, ...)``: the further internal forces, one expression per position. ``q``
        (positions), ``v`` (velocities), ``u`` (inputs) and ``t`` (time) are passed by name if they
        are arguments; every other argument is a parameter.

    Returns
    -------
    callable
        The drift.

    Raises
    ------
    ModelError
        If a matrix is not square or not finite, if ``mass`` is singular, or, when the system is
        made, if states, matrices and inputs do not fit together.

    Notes
    -----
    The inputs of a system are external forces, one for each position. If ``force`` has the argument
    ``u``, they enter there alone, in any number and with the sign of an internal force: write
    ``-u[0]`` for a force that pushes, ``m * u[0]`` for an acceleration of the ground. A system
    without inputs has no external force.

    Examples
    --------
    Two masses in a row, the first on a hardening spring, the second pushed:

    >>> import pymc_statespace_filters as psf
    >>> drift = psf.mechanics.second_order(
    ...     mass=[[1.0, 0.0], [0.0, 2.0]],
    ...     damping=lambda c: [[2 * c, -c], [-c, c]],
    ...     stiffness=lambda k: [[2 * k, -k], [-k, k]],
    ...     force=lambda q, u, k3: [k3 * q[0] ** 3, -u[0]],
    ... )
    >>> system = psf.StateSpaceModel(
    ...     transition=psf.EulerMaruyama(drift, [[0.0], [0.0], [0.1], [0.1]], dt=0.01),
    ...     observation=lambda x: [x[1]],
    ...     observation_noise=[[0.01]],
    ...     initial_mean=[0.0, 0.0, 0.0, 0.0],
    ...     initial_cov=[[0.0] * 4] * 4,
    ...     inputs=["push"],
    ... )
    >>> system.parameters
    ('c', 'k', 'k3')
    """
    matrices = [
        _read_matrix(role, value)
        for role, value in (("mass", mass), ("damping", damping), ("stiffness", stiffness))
    ]
    if isinstance(matrices[0], np.ndarray):
        _check_invertible(matrices[0])
    forces = None if force is None else read_equation("force", force, "qvut")
    functions = [part for part in (*matrices, forces) if isinstance(part, Equation)]
    if "v" in parameter_names(functions)[0]:
        raise ModelError("mass, damping and stiffness must have no parameter 'v', the velocities")
    symbols = ["x", "u"] + ["t"] * (forces is not None and "t" in forces.symbols)

    def drift(**values: Any) -> TensorVariable:
        return _drift(matrices, forces, values)

    drift.__signature__ = _signature(symbols, functions)  # type: ignore[attr-defined]
    if forces is None or "u" not in forces.symbols:
        drift.inputs_are_optional = True  # type: ignore[attr-defined]
    return drift


def _read_matrix(role: str, value: Any) -> Equation | np.ndarray:
    if callable(value):
        return read_equation(role, value, "")
    try:
        matrix = np.array(value, dtype="float64")
    except (TypeError, ValueError):
        matrix = np.array(np.nan)
    if matrix.ndim == 0:
        matrix = matrix.reshape(1, 1)
    if matrix.ndim != 2 or len(set(matrix.shape)) > 1 or not np.isfinite(matrix).all():
        raise ModelError(
            f"{role} must be a square matrix of finite numbers, or a function of parameters that "
            f"returns a matrix, got {shortened(value)}"
        )
    return matrix


def _check_invertible(mass: np.ndarray) -> None:
    if np.linalg.matrix_rank(mass) < len(mass):
        raise ModelError(f"mass must be an invertible matrix, got {mass.tolist()}")


def _signature(symbols: Sequence[str], functions: Sequence[Equation]) -> inspect.Signature:
    """The arguments of the drift: reserved ones, then the parameters of its functions."""
    names, defaults = parameter_names(functions)
    given = dict(defaults)
    kind = inspect.Parameter.KEYWORD_ONLY
    arguments = [inspect.Parameter(name, kind) for name in symbols]
    arguments += [
        inspect.Parameter(name, kind, default=given.get(name, inspect.Parameter.empty))
        for name in names
    ]
    return inspect.Signature(arguments)


def _drift(
    matrices: Sequence[Equation | np.ndarray], forces: Equation | None, values: Mapping[str, Any]
) -> TensorVariable:
    """Velocities and accelerations."""
    x, u = values["x"], values["u"]
    n, odd = divmod(x.type.shape[0], 2)
    if odd:
        raise ModelError(
            "second_order needs a velocity for every position, so an even number of states, got "
            f"{2 * n + 1}"
        )
    named = {**values, "q": x[:n], "v": x[n:]}
    mass, damping, stiffness = (
        _matrix(role, matrix, named, n)
        for role, matrix in zip(("mass", "damping", "stiffness"), matrices, strict=True)
    )
    total = -(damping @ named["v"]) - stiffness @ named["q"]
    if forces is not None:
        total = total - as_vector("force", forces(named), n)
    if (forces is None or "u" not in forces.symbols) and (n_inputs := u.type.shape[0]):
        if n_inputs != n:
            raise ModelError(
                f"inputs of second_order must be one force per position ({n}), got {n_inputs}: "
                "name as many, or let force have the argument u and say where the inputs act"
            )
        total = total + u
    return pt.concatenate([named["v"], _solve(matrices[0], mass, total)])


def _matrix(
    role: str, matrix: Equation | np.ndarray, values: Mapping[str, Any], n: int
) -> TensorVariable:
    symbol = as_symbol(role, matrix(values) if isinstance(matrix, Equation) else matrix)
    return as_matrix(role, symbol.reshape((1, 1)) if symbol.type.ndim == 0 else symbol, n, n)


def _solve(
    given: Equation | np.ndarray, mass: TensorVariable, total: TensorVariable
) -> TensorVariable:
    """The accelerations, which the mass matrix multiplied by gives the total force."""
    if isinstance(given, Equation):
        return total / mass[0, 0] if mass.type.shape == (1, 1) else pt.linalg.solve(mass, total)
    if np.array_equal(given, np.diag(np.diag(given))):
        return total / np.diag(given)
    return np.linalg.inv(given) @ total
