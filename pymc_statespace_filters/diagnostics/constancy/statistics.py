r"""Statistics of constancy from scores, of data and of data simulated at their mode; p-values.

If a parameter walks at random with variance gamma per unit of time, the derivative of the
log-likelihood by gamma at zero is half of

.. math::

    \sum_j (t_j - t_{j-1}) (R_j^2 - I_j), \qquad R_j = \sum_{i \ge j} h_i, \quad
    I_j = \sum_{i \ge j} c_i,

with h_i the score of term i by the parameter and c_i its curvature, minus the second derivative
(Nyblom 1989). The locally most powerful test rejects where it is large: gamma is not negative.
Exact would be derivatives of each term by the parameter from row j on; those by the constant
parameter differ from them while the filter remembers what was before.

The scores are projected on those of the estimated parameters, so that their sums vanish for these
whatever the point at which they were taken: :math:`h_i (1 - b \cdot g_i)` with g_i the scores by
all estimated parameters, :math:`b = (\sum g g^T)^{-1} \sum g`.

Differences from the source: the scores of a record in a panel are summed within it; and the sum has
the observed curvature in place of the sum of squared scores, which a drift increases, so that power
would be lost.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import ModelError
from ...pymc_model.term_scores import ScoredVariable, Scores
from .estimation import Modes, expected_information, modes

CUTOFF = 1e-10  # relative, of singular values
LEAST_CURVATURE = 0.01  # of the sum of squared scores, which has the same mean
LEAST_LEFT = 0.9  # share of the simulated data sets that must have a likelihood
BLOCK_SIZE = 2_000_000  # numbers, of the scores of the data sets that are treated at once
FIRST_SCALE = 0.01  # of the parameters
LEAST_EFFECT = 1e-12  # squared nats by a step of differences; rounding has about 1e-28

Array = NDArray[np.float64]


class Constancy(NamedTuple):
    """Of m data sets of J rows and k parameters.

    ``statistic`` (m, k) is the derivative over half the duration and over the curvature of all
    terms, so that its distribution depends little on the parameters; ``remaining`` (m, J, k) are
    the sums R_j over the rows from j to the end of the record, and ``squares`` (m, J, k) those of h
    squared, of which the mean is the information in these rows.
    """

    statistic: Array
    remaining: Array
    squares: Array


def constancy(scores: Scores, durations: Array, of_rows: NDArray[np.int64]) -> Constancy:
    """Statistics of scores; ``durations`` (J,) are the times since the row before.

    ``of_rows`` (J,) is the number of the record of each row: each has a path of its own.
    """
    h = scores.by_theta * _projection(scores.by_x)[..., None]
    parts = h, h**2, scores.curvature
    remaining, squares, curvature = (_from_each_row(part, of_rows) for part in parts)
    weighted = np.einsum("j,mjk->mk", durations, remaining**2 - curvature)
    total = np.maximum(scores.curvature.sum(axis=1), LEAST_CURVATURE * (h**2).sum(axis=1))
    total = np.maximum(total, np.finfo(float).tiny)
    return Constancy(weighted / durations.sum() / total, remaining, squares)


def _projection(by_x: Array) -> Array:
    """The factors (m, J) by which all scores are multiplied."""
    products = np.einsum("mjx,mjy->mxy", by_x, by_x)
    inverse = np.linalg.pinv(products, rcond=CUTOFF, hermitian=True)
    b = np.einsum("mxy,my->mx", inverse, by_x.sum(axis=1))
    return np.asarray(1.0 - np.einsum("mjx,mx->mj", by_x, b))


def _from_each_row(values: Array, of_rows: NDArray[np.int64]) -> Array:
    """Sums over the rows (m, J, k) from each one to the end of its record."""
    sums = np.cumsum(values[:, ::-1], axis=1)[:, ::-1]
    lasts = np.append(np.flatnonzero(np.diff(of_rows)), len(of_rows) - 1)
    after = np.concatenate([sums[:, 1:], np.zeros_like(sums[:, :1])], axis=1)
    return np.asarray(sums - after[:, lasts][:, of_rows])


class Statistics(NamedTuple):
    """Of the data and of B simulated data sets, for k parameters.

    ``data`` (k,) and ``simulated`` (B, k) are those of `Constancy`; ``remaining``
    (J, k) are the sums of the data, ``largest`` (B, k) the largest sums of the simulated ones, and
    ``information`` (J, k) is the mean of the squared sums of a constant parameter over the rows
    from each one to the end of its record, ``total`` (k,) over all rows.
    """

    data: Array
    simulated: Array
    remaining: Array
    largest: Array
    information: Array
    total: Array


class ConstancyTest:
    """The statistics of a variable's data and of simulated ones.

    ``mode`` is that of the data; ``on_progress`` is called with the number of simulated data sets
    since its last call.
    """

    def __init__(self, variable: ScoredVariable, durations: Array, start: Array) -> None:
        self.on_progress: Callable[[int], None] = lambda count: None
        self.variable, self._durations = variable, durations
        scale = _first_scale(variable, start)
        first = modes(variable, start[None], variable.observed[None], scale)
        self._scale = _standard_errors(variable, first, scale)
        self.mode = modes(variable, first.x, variable.observed[None], self._scale)
        if not np.isfinite(self.mode.scores.terms).all():
            raise ModelError(
                f"the filter of {variable.name!r} has no likelihood at the best of the draws: the "
                "draws belong to another model or to other data"
            )

    def moving(self) -> NDArray[np.bool_]:
        """Which parameters depend on free variables."""
        return np.asarray(self.variable.jacobian(self.mode.x).any(axis=(0, 1, 3)))

    def has_effect(self) -> NDArray[np.bool_]:
        """Which parameters change the likelihood at the mode; a noise at zero does not."""
        information = (self.mode.scores.by_theta[0] ** 2).sum(axis=0)
        return np.asarray(information * self._scale**2 > LEAST_EFFECT)

    def run(
        self, chosen: NDArray[np.int64], n_simulated: int, rng: np.random.Generator
    ) -> Statistics:
        """Compare the data with simulated ones, in the parameters with these numbers."""
        simulated = self._possible(n_simulated, rng)
        blocks = self._blocks(simulated)
        first = blocks[0]
        at_mode = np.repeat(self.mode.x, len(first), axis=0)
        information = expected_information(self.variable.scores(at_mode, first, self._scale))
        found = [self._constancy(block, information, chosen) for block in blocks]
        data = self._constancy(self.variable.observed[None], information, chosen)
        squares = np.sum([one.squares.sum(axis=0) for one in found], axis=0) / len(simulated)
        firsts = np.flatnonzero(np.diff(self.variable.of_rows, prepend=-1))
        return Statistics(
            data.statistic[0],
            np.concatenate([one.statistic for one in found]),
            data.remaining[0],
            np.concatenate([np.abs(one.remaining).max(axis=1) for one in found]),
            squares,
            squares[firsts].sum(axis=0),
        )

    def _possible(self, count: int, rng: np.random.Generator) -> Array:
        """Simulated data sets that have a likelihood at the mode of the data."""
        variable, x = self.variable, self.mode.x
        simulated = variable.simulate(x[0], count, rng)
        theta = np.repeat(variable.theta(x), count, axis=0)
        possible = np.isfinite(variable.terms(theta, simulated)).all(axis=1)
        if possible.sum() < LEAST_LEFT * count:
            raise ModelError(
                f"{(~possible).sum()} of {count} simulated data sets have no likelihood at the "
                "posterior mode: the steps of the integrator may be unstable there"
            )
        return simulated[possible]

    def _blocks(self, simulated: Array) -> list[Array]:
        n_numbers = len(self.variable.of_rows) * (self.mode.x.shape[1] + len(self._scale))
        size = max(1, BLOCK_SIZE // n_numbers)
        return [simulated[begin : begin + size] for begin in range(0, len(simulated), size)]

    def _constancy(
        self, observed: Array, information: Array, chosen: NDArray[np.int64]
    ) -> Constancy:
        """The statistics of data sets (m, J, p), each at its own mode."""
        start = np.repeat(self.mode.x, len(observed), axis=0)
        scores = modes(self.variable, start, observed, self._scale, information).scores
        scores = scores._replace(
            by_theta=scores.by_theta[..., chosen], curvature=scores.curvature[..., chosen]
        )
        self.on_progress(len(observed))
        return constancy(scores, self._durations, self.variable.of_rows)


def _first_scale(variable: ScoredVariable, start: Array) -> Array:
    """The order of magnitude of the errors of theta (k,)."""
    theta = np.abs(variable.theta(start[None])[0]).mean(axis=0)
    return np.where(theta > 0, FIRST_SCALE * theta, FIRST_SCALE)


def _standard_errors(variable: ScoredVariable, found: Modes, scale: Array) -> Array:
    """Standard errors of theta (k,), where the data determine it; else the scale (k,)."""
    by_x = found.scores.by_x[0]
    cov = np.linalg.pinv(by_x.T @ by_x, hermitian=True)
    jacobian = variable.jacobian(found.x)[0].mean(axis=0)
    errors = np.sqrt(np.maximum(np.einsum("kx,xy,ky->k", jacobian, cov, jacobian), 0.0))
    return np.where(errors > 0, np.minimum(errors, 10 * scale), scale)


class PValues(NamedTuple):
    """p-values (k,) of each parameter alone, and of the smallest of all of them."""

    alone: Array
    adjusted: Array


def p_values(observed: Array, simulated: Array) -> PValues:
    """Compare statistics (k,) of the data with those of simulated data (B, k).

    The adjusted ones hold for all parameters together: each is the share of data sets in which the
    smallest p-value of all is as small (Westfall and Young 1993, single-step minP).
    """
    everything = np.concatenate([observed[None], simulated])
    # Of each data set, how many are as large, itself included.
    order = np.sort(everything, axis=0)
    as_large = [
        len(everything) - np.searchsorted(column, values, side="left")
        for column, values in zip(order.T, everything.T, strict=True)
    ]
    alone = np.stack(as_large, axis=1) / len(everything)
    smallest = alone.min(axis=1)
    return PValues(alone[0], (smallest[:, None] <= alone[0]).mean(axis=0))
