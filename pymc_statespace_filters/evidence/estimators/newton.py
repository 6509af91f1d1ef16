"""The largest value of a smooth function near the draws: Newton's method on differences.

Of more than fifty parameters the Hessian is not made, only its products with directions.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

STEP = 0.01  # of the differences, in standard deviations of the draws
MAX_GRADIENT = 1e-4  # nats per standard deviation
MAX_ITERATIONS = 100
MANY = 50  # parameters whose Hessian is too large: products with it take its place
# Steps in a row that gain next to nothing end a climb: on a ridge the gradient may never vanish.
MIN_GAIN, MAX_IDLE = 1e-7, 5

Array = NDArray[np.float64]
Rows = Callable[[Array], Array]


class Top(NamedTuple):
    """Where a climb ended."""

    point: Array  # (k,)
    value: float
    at_edge: bool  # one difference step further there is no value


class EdgeError(Exception):
    """The function is minus infinity within one step of a point."""


def best_of_chains(values: Array, n_best: int) -> NDArray[np.int64]:
    """Flat indices of the best draw of each chain, the best `n_best` of them, best first."""
    flat = values.argmax(axis=1) + np.arange(len(values)) * values.shape[1]
    return flat[np.argsort(-values.ravel()[flat], kind="stable")][:n_best]


def derivatives(function: Rows, point: Array, step: float) -> tuple[Array, Array]:
    """Gradient (k,) and Hessian (k, k) by central differences; k (k + 1) + 1 points in one call.

    The mixed ones need the two diagonal neighbours alone, f(x + h e_i + h e_j) and f(x - h e_i - h
    e_j), because the neighbours along the axes are there already.

    Raises
    ------
    EdgeError
        If the function is minus infinity at one of the points.
    """
    k = len(point)
    axes = step * np.eye(k)
    i, j = np.triu_indices(k, 1)
    diagonals = axes[i] + axes[j]
    offsets = np.concatenate([np.zeros((1, k)), axes, -axes, diagonals, -diagonals])
    values = function(point + offsets)
    if not np.isfinite(values).all():
        raise EdgeError
    centre, up, down, *_ = np.split(values, np.cumsum([1, k, k]))
    forth, back = np.split(values[2 * k + 1 :], 2)
    hessian = np.diag((up + down - 2 * centre) / step**2)
    along = up + down
    hessian[i, j] = hessian[j, i] = (forth + back + 2 * centre - along[i] - along[j]) / (
        2 * step**2
    )
    return (up - down) / (2 * step), hessian


def gradient(function: Rows, point: Array, step: float) -> Array:
    """Gradient (k,) by central differences; 2 k points in one call.

    Raises
    ------
    EdgeError
        If the function is minus infinity at one of the points.
    """
    axes = step * np.eye(len(point))
    values = function(np.concatenate([point + axes, point - axes]))
    if not np.isfinite(values).all():
        raise EdgeError
    up, down = np.split(values, 2)
    return (up - down) / (2 * step)


def curvature_along(function: Rows, point: Array, direction: Array, step: float) -> Array:
    """Product (k,) of the Hessian with a direction, from the gradients on either side."""
    length = np.linalg.norm(direction)
    if length == 0:
        return np.zeros_like(point)
    move = step / length * direction
    ahead, behind = (gradient(function, point + m, step) for m in (move, -move))
    return (ahead - behind) * length / (2 * step)


def climb(function: Rows, start: Array) -> Top:
    """Go up from `start` (k,) until the gradient vanishes, or until one step leads off an edge.

    A trust region bears with minus infinity, which is a step too far, with Hessians of any sign,
    and with functions that level off towards infinity, where it stops.
    """
    known: dict[bytes, tuple[Array, Array]] = {}
    best = Top(start, -np.inf, at_edge=False)
    before, n_idle = -np.inf, 0

    def descent(z: Array) -> float:
        nonlocal best
        value = float(function(z[np.newaxis])[0])
        if value > best.value:
            best = Top(z.copy(), value, at_edge=False)
        return -value

    def differences(z: Array) -> tuple[Array, Array]:
        if z.tobytes() not in known:  # gradient and Hessian are asked for one after the other
            known.clear()
            known[z.tobytes()] = derivatives(function, z, STEP)
        return known[z.tobytes()]

    def stop_if_idle(_: Array) -> None:
        nonlocal before, n_idle
        n_idle = n_idle + 1 if best.value < before + MIN_GAIN else 0
        before = best.value
        if n_idle == MAX_IDLE:
            raise StopIteration

    if len(start) <= MANY:
        method: dict[str, Any] = {
            "method": "trust-exact",
            "jac": lambda z: -differences(z)[0],
            "hess": lambda z: -differences(z)[1],
        }
    else:
        method = {
            "method": "trust-ncg",
            "jac": lambda z: -gradient(function, z, STEP),
            "hessp": lambda z, p: -curvature_along(function, z, p, STEP),
        }
    try:
        minimize(
            descent,
            start,
            **method,
            callback=stop_if_idle,
            options={"gtol": MAX_GRADIENT, "maxiter": MAX_ITERATIONS},
        )
    except EdgeError:
        return best._replace(at_edge=True)
    return best
