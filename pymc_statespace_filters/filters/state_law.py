"""The law of the state that a filter leaves, and draws of it, at many points at once.

What a filter leaves after a row is a vector, see `evaluation.run_filter`: a step, and the numbers
of its law. All laws are mixtures of weighted parts. A part has exact values of some states, and
mean and covariance of the others.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Layout(NamedTuple):
    """What the columns of a filter's parts hold: ``rows`` numbers, of which some are exact states.

    The others are the means and the lower triangle of the covariance of the other states.
    ``order`` (n,) tells where each state of the system is among these.
    """

    rows: int
    n_exact: int
    order: NDArray[np.int64]


def exact_states(n: int) -> Layout:
    """The layout of members that are states."""
    return Layout(n, n, np.arange(n))


def gaussian_states(n: int) -> Layout:
    """The layout of Gaussians: the mean and the lower triangle of the covariance."""
    return Layout(n + n * (n + 1) // 2, 0, np.arange(n))


class StateLaw(NamedTuple):
    """Mixtures of K parts at m points.

    ``log_weights`` (m, K). A column of ``parts`` (m, rows, K) has the exact states, then the means
    of the others and the lower triangle of their covariance. ``order`` (n,) tells where each state
    of the system is among these.
    """

    log_weights: Array
    parts: Array
    n_exact: int
    order: NDArray[np.int64]

    @property
    def are_points(self) -> bool:
        """Whether the parts are exact states."""
        return self.n_exact == self.order.size

    def drawn(self, rng: np.random.Generator) -> Array:
        """One state (m, n) at each point; NaN where no part is finite."""
        m, n, n_parts = len(self.parts), self.order.size, self.log_weights.shape[1]
        log_w = np.where(np.isfinite(self.parts).all(axis=1), self.log_weights, -np.inf)
        highest = log_w.max(axis=1, keepdims=True)
        known = np.isfinite(highest[:, 0])
        with np.errstate(invalid="ignore"):
            ends = np.exp(log_w - highest).cumsum(axis=1)
        chosen = (ends <= rng.random((m, 1)) * ends[:, -1:]).sum(axis=1)
        part = np.minimum(chosen, n_parts - 1)[:, np.newaxis, np.newaxis]
        columns = np.take_along_axis(self.parts, part, axis=2)[:, :, 0]
        x = columns[:, :n].copy()
        x[:, self.n_exact :] += _normal(columns[:, n:], n - self.n_exact, rng)
        return np.where(known[:, np.newaxis], x[:, self.order], np.nan)

    def moments(self) -> tuple[Array, Array]:
        """Mean (m, n) and covariance (m, n, n) at each point."""
        n, n_exact = self.order.size, self.n_exact
        highest = self.log_weights.max(axis=1, keepdims=True)
        weights = np.exp(self.log_weights - highest)
        weights /= weights.sum(axis=1, keepdims=True)
        x = np.where(weights[:, None] > 0.0, self.parts[:, :n], 0.0)
        mean = np.einsum("mk,mik->mi", weights, x)
        apart = x - mean[:, :, None]
        cov = np.einsum("mk,mik,mjk->mij", weights, apart, apart)
        rows, columns = np.tril_indices(n - n_exact)
        own = np.einsum("mk,mtk->mt", weights, self.parts[:, n:])
        cov[:, n_exact + rows, n_exact + columns] += own
        below = rows > columns
        cov[:, n_exact + columns[below], n_exact + rows[below]] += own[:, below]
        return mean[:, self.order], cov[:, self.order][:, :, self.order]


def _normal(triangles: Array, n: int, rng: np.random.Generator) -> Array:
    """Normals (m, n) of mean zero, of covariances by their lower triangles, perhaps singular."""
    cov = np.zeros((len(triangles), n, n))
    rows, columns = np.tril_indices(n)
    cov[:, rows, columns] = cov[:, columns, rows] = np.nan_to_num(triangles)
    values, vectors = np.linalg.eigh(cov)
    z = np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal((len(cov), n))
    return np.asarray((vectors @ z[:, :, np.newaxis])[:, :, 0])


def law_of_parts(states: Array, layout: Layout) -> StateLaw:
    """Of columns and their log weights behind them, from vectors (m, 1 + (rows + 1) * K)."""
    rows, n_exact, order = layout
    m, size = len(states), (states.shape[1] - 1) // (rows + 1)
    parts = states[:, 1 : 1 + rows * size].reshape(m, rows, size)
    return StateLaw(states[:, 1 + rows * size :], parts, n_exact, order)


def law_of_moments(states: Array, n: int) -> StateLaw:
    """Of one Gaussian, or of an exact state where no covariance follows the mean."""
    n_exact = n if states.shape[1] == 1 + n else 0
    return StateLaw(np.zeros((len(states), 1)), states[:, 1:, np.newaxis], n_exact, np.arange(n))


def law_of_values(states: Array, values: Array) -> StateLaw:
    """Of exact states, the rows of ``values`` (K, n), from their probabilities (m, 1 + K)."""
    (n_values, n), m = values.shape, len(states)
    with np.errstate(divide="ignore"):
        log_weights = np.log(states[:, 1:])
    parts = np.broadcast_to(values.T, (m, n, n_values))
    return StateLaw(log_weights, parts, n, np.arange(n))


def law_of_regimes(states: Array, regimes: Array, order: NDArray[np.int64]) -> StateLaw:
    """Of Gaussians given regimes (K, n_exact), whose probabilities follow the moments of all."""
    n, (n_regimes, n_exact), m = order.size, regimes.shape, len(states)
    behind = states[:, 1 + n + n * (n + 1) // 2 :]
    moments = behind[:, n_regimes:].reshape(m, n_regimes, -1).swapaxes(1, 2)
    known = np.broadcast_to(regimes.T, (m, n_exact, n_regimes))
    with np.errstate(divide="ignore"):
        log_weights = np.log(behind[:, :n_regimes])
    return StateLaw(log_weights, np.concatenate([known, moments], axis=1), n_exact, order)
