"""Laws of the state on the grid of the point-mass filter: forwards, and back over the record.

With l_j(x) = p(d_j | x) and the kernel p(x' | x) of the steps between two times,

    forwards   a(x') = integral of p(x' | x) a(x) l(x) dx,    the predicted law, times a constant,
    back       b(x) = integral of p(x' | x) l(x') b(x') dx',  p(later observations | x),

so that the predicted, filtered and smoothed laws are proportional to a, a l and a l b.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tests.references.grid import Array, PointMassFilter, normal_density

Function = Callable[[Array], Array]


class StateLaw(NamedTuple):
    """The law of the state at R steps."""

    density: Array  # (R, n_points), on the grid of the filter
    mean: Array  # (R,)
    sd: Array  # (R,)


class GridStates:
    """States of a point-mass filter's system at the steps ``rows``, given a record.

    Parameters
    ----------
    grid : PointMassFilter
        Accurate where its spacing is at most half the deviation of every factor: of the noise of a
        step, and of the sensor.
    steps, observed : array_like, shape (J,)
        The record; NaN is a missing observation.
    rows : array_like of int, shape (R,)
        Increasing steps.
    """

    def __init__(
        self, grid: PointMassFilter, steps: ArrayLike, observed: ArrayLike, rows: ArrayLike
    ) -> None:
        self.grid, self.x = grid, grid.x
        steps = np.asarray(steps)
        self.times = np.union1d(steps, np.asarray(rows))
        self.at = np.searchsorted(self.times, rows)
        self.likelihood = np.ones((self.times.size, self.x.size))
        for i, d in zip(np.searchsorted(self.times, steps), np.asarray(observed), strict=True):
            if not np.isnan(d):
                self.likelihood[i] = normal_density(self.x, d, grid.noise_var)
        self.before, self.after = self._forwards(), self._back()

    def predicted(self) -> StateLaw:
        """Given the observations at earlier steps."""
        return self._law(self.before)

    def filtered(self) -> StateLaw:
        """Given the observations up to and with the step's own."""
        return self._law(self.before * self.likelihood)

    def smoothed(self) -> StateLaw:
        """Given all observations."""
        return self._law(self.before * self.likelihood * self.after)

    def smoothed_mean(self, i: int, j: int, f: Function, g: Function) -> float:
        """E[f(x) g(x') | all observations] of the states x, x' at rows i <= j."""
        start, end = self.at[i], self.at[j]
        whole = self.before[start] * self.likelihood[start]
        part = f(self.x) * whole
        for k in range(start + 1, end + 1):
            whole, part = (
                self.grid.predict(v, self._gap(k)) * self.likelihood[k] for v in (whole, part)
            )
            whole, part = whole / whole.sum(), part / whole.sum()
        after = self.after[end]
        return float(part @ (g(self.x) * after) / (whole @ after))

    def smoothed_covariance(self, i: int, j: int) -> float:
        """Covariance of the states at rows i <= j, given all observations."""
        mean = self.smoothed().mean
        return self.smoothed_mean(i, j, lambda x: x - mean[i], lambda x: x - mean[j])

    def _gap(self, k: int) -> int:
        """Steps from the time before to time k; the first time may be later than step 0."""
        return int(self.times[k] - (self.times[k - 1] if k else 0))

    def _forwards(self) -> NDArray[np.float64]:
        """(T, n_points): the predicted density at every time."""
        before, density = np.empty_like(self.likelihood), self.grid.prior
        for k in range(self.times.size):
            before[k] = self.grid.predict(density, self._gap(k))
            density = before[k] * self.likelihood[k]
            density = density / (self.grid.spacing * density.sum())
        return before

    def _back(self) -> NDArray[np.float64]:
        """(T, n_points): p(later observations | x), each time to a constant of its own."""
        after = np.ones_like(self.likelihood)
        for k in range(self.times.size - 1, 0, -1):
            later = after[k] * self.likelihood[k]
            after[k - 1] = self.grid.predict_back(later / later.max(), self._gap(k))
        return after

    def _law(self, weights: Array) -> StateLaw:
        density = weights[self.at]
        density = density / (self.grid.spacing * density.sum(axis=1, keepdims=True))
        mean = self.grid.spacing * density @ self.x
        square = (self.x - mean[:, None]) ** 2
        sd = np.sqrt(self.grid.spacing * (density * square).sum(axis=1))
        return StateLaw(density, mean, sd)
