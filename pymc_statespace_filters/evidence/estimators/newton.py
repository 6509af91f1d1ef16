"""Maximise a smooth function by a trust-region Newton method with finite differences.

The coordinates are scaled such that the posterior draws have unit variance. Above fifty parameters
the Hessian is not formed; only its products with directions are computed. Where the gradient is
known, the Hessian is its difference at the start, and then follows the gradient (the symmetric
update of rank one: Conn, Gould and Toint 1991, Math. Program. 50, 177-195).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

STEP = 0.01  # of the differences, in standard deviations of the draws
MAX_GRADIENT = 1e-4  # nats per standard deviation
MAX_ITERATIONS = 100
MIN_UPDATE = 1e-8  # cosine between a move and what the Hessian lacks along it
MAX_DENSE = 50  # parameters; above, Hessian-vector products replace the Hessian
# Stop after MAX_IDLE steps in a row that gain less: on a ridge the gradient may never vanish.
MIN_GAIN, MAX_IDLE = 1e-7, 5

Array = NDArray[np.float64]
BatchFunction = Callable[[Array], Array]


class WithGradient:
    """A function of points whose gradient is known.

    ``with_slopes`` gives values (m,) and gradients (m, k) at points (m, k).
    """

    def __init__(
        self, values: BatchFunction, with_slopes: Callable[[Array], tuple[Array, Array]]
    ) -> None:
        self._values, self.with_slopes = values, with_slopes

    def __call__(self, x: Array) -> Array:
        """Values (m,) alone."""
        return self._values(x)

    def slopes(self, x: Array) -> Array:
        """Gradients (m, k).

        Raises `EdgeError` if the function is not finite at one of the points.
        """
        values, found = self.with_slopes(x)
        if not (np.isfinite(values).all() and np.isfinite(found).all()):
            raise EdgeError
        return found


def along(function: BatchFunction, point: Array, scale: Array) -> BatchFunction:
    """The function in coordinates z of x = point + scale z."""

    def values(z: Array) -> Array:
        return function(point + z @ scale.T)

    if not isinstance(function, WithGradient):
        return values
    with_slopes = function.with_slopes

    def scaled(z: Array) -> tuple[Array, Array]:
        found, slopes = with_slopes(point + z @ scale.T)
        return found, slopes @ scale

    return WithGradient(values, scaled)


class Maximum(NamedTuple):
    """The best point that was evaluated."""

    point: Array  # (k,)
    value: float
    at_edge: bool  # the function is -inf within one difference step


class EdgeError(Exception):
    """The function is -inf within one difference step of a point."""


def best_of_chains(values: Array, n_best: int) -> NDArray[np.int64]:
    """Flat indices of the largest value in each chain, best first, at most `n_best`."""
    flat = values.argmax(axis=1) + np.arange(len(values)) * values.shape[1]
    return flat[np.argsort(-values.ravel()[flat], kind="stable")][:n_best]


def derivatives(function: BatchFunction, point: Array, step: float) -> tuple[Array, Array]:
    """Gradient (k,) and Hessian (k, k) by central differences; k (k + 1) + 1 points in one call.

    A mixed derivative takes only two further points, f(x + h e_i + h e_j) and f(x - h e_i - h e_j),
    beside the points along the axes. The differences of a known gradient take 2 k + 1 points.
    Raises `EdgeError` if the function is not finite at one of the points.
    """
    k = len(point)
    axes = step * np.eye(k)
    if isinstance(function, WithGradient):
        here, *around = function.slopes(point + np.concatenate([np.zeros((1, k)), axes, -axes]))
        ahead, behind = np.reshape(around, (2, k, k))
        hessian = (ahead - behind) / (2 * step)
        return here, 0.5 * (hessian + hessian.T)
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


def gradient(function: BatchFunction, point: Array, step: float) -> Array:
    """Gradient (k,), known or by central differences; 2 k points in one call.

    Raises `EdgeError` if the function is not finite at one of the points.
    """
    if isinstance(function, WithGradient):
        return function.slopes(point[None])[0]
    axes = step * np.eye(len(point))
    values = function(np.concatenate([point + axes, point - axes]))
    if not np.isfinite(values).all():
        raise EdgeError
    up, down = np.split(values, 2)
    return (up - down) / (2 * step)


def curvature_along(function: BatchFunction, point: Array, direction: Array, step: float) -> Array:
    """Product (k,) of the Hessian with a direction, by central differences of the gradient."""
    length = np.linalg.norm(direction)
    if length == 0:
        return np.zeros_like(point)
    move = step / length * direction
    ahead, behind = (gradient(function, point + m, step) for m in (move, -move))
    return (ahead - behind) * length / (2 * step)


def newton_maximize(function: BatchFunction, start: Array) -> Maximum:
    """Maximise from `start` (k,) until the gradient vanishes or the edge of the support is met.

    The trust region copes with values of -inf (a step too far), with indefinite Hessians, and with
    functions that level off towards infinity, where the search stops.
    """
    search = _Search(function, start)
    method: dict[str, Any]
    if len(start) <= MAX_DENSE:
        method = {"method": "trust-exact", "jac": search.gradient, "hess": search.hessian}
    else:
        method = {
            "method": "trust-ncg",
            "jac": lambda z: -gradient(function, z, STEP),
            "hessp": lambda z, p: -curvature_along(function, z, p, STEP),
        }
    try:
        minimize(
            search.objective,
            start,
            **method,
            callback=search.stop_if_idle,
            options={"gtol": MAX_GRADIENT, "maxiter": MAX_ITERATIONS},
        )
    except EdgeError:
        return search.best._replace(at_edge=True)
    return search.best


class _Search:
    """Objective and derivatives for SciPy's minimiser, and the best point so far."""

    def __init__(self, function: BatchFunction, start: Array) -> None:
        self._function = function
        self.best = Maximum(start, -np.inf, at_edge=False)
        self._previous, self._n_idle = -np.inf, 0
        self._known: dict[bytes, tuple[Array, Array]] = {}
        self._last: tuple[Array, Array, Array] | None = None  # point, gradient, Hessian

    def objective(self, z: Array) -> float:
        """Minus the function."""
        value = float(self._function(z[np.newaxis])[0])
        if value > self.best.value:
            self.best = Maximum(z.copy(), value, at_edge=False)
        return -value

    def gradient(self, z: Array) -> Array:
        """Gradient of the objective."""
        return -self._derivatives(z)[0]

    def hessian(self, z: Array) -> Array:
        """Hessian of the objective."""
        return -self._derivatives(z)[1]

    def _derivatives(self, z: Array) -> tuple[Array, Array]:
        if z.tobytes() not in self._known:  # SciPy asks for the two one after the other
            self._known = {z.tobytes(): self._found(z)}
        return self._known[z.tobytes()]

    def _found(self, z: Array) -> tuple[Array, Array]:
        """By differences, or those of the last point updated by a known gradient."""
        if self._last is None or not isinstance(self._function, WithGradient):
            slope, hessian = derivatives(self._function, z, STEP)
        else:
            before, slope_before, hessian = self._last
            slope, move = self._function.slopes(z[None])[0], z - before
            rest = slope - slope_before - hessian @ move
            along_move = float(rest @ move)
            if abs(along_move) > MIN_UPDATE * np.linalg.norm(rest) * np.linalg.norm(move):
                hessian = hessian + np.outer(rest, rest) / along_move
        self._last = z.copy(), slope, hessian
        return slope, hessian

    def stop_if_idle(self, _: Array) -> None:
        """Stop after `MAX_IDLE` iterations in a row without a gain."""
        idle = self.best.value < self._previous + MIN_GAIN
        self._n_idle = self._n_idle + 1 if idle else 0
        self._previous = self.best.value
        if self._n_idle == MAX_IDLE:
            raise StopIteration
