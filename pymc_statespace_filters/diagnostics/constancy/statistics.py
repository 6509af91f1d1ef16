r"""Statistics of constancy from scores, and their p-values.

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

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...pymc_model.term_scores import Scores

CUTOFF = 1e-10  # relative, of singular values
LEAST_CURVATURE = 0.01  # of the sum of squared scores, which has the same mean

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
