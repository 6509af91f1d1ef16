r"""The expected Fisher information of the record of a model, at points of its parameters.

The score of a record is a sum over its rows of scores given the rows before, which have mean zero
and are uncorrelated (a martingale). So

.. math::

    F = \sum_j E[g_j g_j^T]

needs as many records fewer than the mean of the products of whole scores as a record has rows.
"""

from collections.abc import Callable

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import rankdata

from ..pymc_model.at_points import ConstrainedValues
from ..pymc_model.elements import places_in_vector
from ..pymc_model.inspection import state_space_nodes
from ..pymc_model.posterior_draws import unconstraining
from ..pymc_model.term_scores import ScoredVariable

STEP = 1e-6  # of differences, in standard deviations of the prior
FAR_OUT = 30.0  # in the unconstrained space: near the end of a support
ONE_SD = 0.15865525393145707  # probability below a normal variable's mean minus its sd
BLOCK_SIZE = 2_000_000  # numbers of simulated data that are treated at once
LEAST_LEFT = 0.5  # share of the simulated records that must have a likelihood
N_TRIED = 20  # records, to have one that is finite
HUGE = 1e7  # score of a row by a standard deviation of the prior, of a state that explodes

Array = NDArray[np.float64]


class Coordinates:
    """What sds are of: logarithms of parameters that are positive, all others as they are.

    A variable whose unconstrained vector is shorter than itself, such as a simplex, is taken in the
    unconstrained space. ``kinds`` (k,) are ``"log"``, ``"value"`` or ``"unconstrained"``.
    """

    def __init__(self, model: pm.Model) -> None:
        self._values, self._places = ConstrainedValues(model), places_in_vector(model)
        self._unconstrained = unconstraining(model)
        k = sum(at.size for at in self._places.values())
        kinds = np.full(k, "unconstrained")
        with np.errstate(all="ignore"):
            ends = self._values(np.array([[-FAR_OUT] * k, [FAR_OUT] * k]))
        for name, at in self._places.items():
            if ends[name].shape[1:] == at.shape:
                kinds[at] = np.where((ends[name] >= 0).all(axis=0), "log", "value")
        self.kinds = kinds

    def __call__(self, x: Array) -> Array:
        """The coordinates (m, k) of points x (m, k) of the unconstrained space."""
        y = x.copy()
        for name, value in self._values(x).items():
            at = self._places[name].ravel()
            if self.kinds[at[0]] != "unconstrained":
                y[:, at] = value.reshape(len(x), -1)
        y[:, self.kinds == "log"] = np.log(y[:, self.kinds == "log"])
        return y

    def inverse(self, y: Array) -> Array:
        """The points (m, k) that have these coordinates; not finite outside the support."""
        x = np.where(self.kinds == "unconstrained", y, 0.0)
        values = self._values(x)
        for name, at in self._places.items():
            own = y[:, at.ravel()]
            if self.kinds[at.flat[0]] != "unconstrained":
                own = np.where(self.kinds[at.ravel()] == "log", np.exp(own), own)
                values[name] = own.reshape(values[name].shape)
        return self._unconstrained(values)

    def jacobian(self, x: Array, sd: Array) -> Array:
        """The derivatives (m, k, k) of the coordinates by the unconstrained vector at x (m, k)."""
        moves, (m, k) = 1e-5 * np.diag(sd), x.shape
        up, down = (self((x[:, None] + t * moves).reshape(-1, k)).reshape(m, k, k) for t in (1, -1))
        return np.swapaxes((up - down) / (2e-5 * sd[:, None]), 1, 2)


def spread(y: Array) -> Array:
    """Half the width (k,) of the central 68.3 % of draws (n, k): of a normal law, its sd.

    Heavy tails, which make a standard deviation large or infinite, do not count.
    """
    low, high = np.quantile(y, [ONE_SD, 1 - ONE_SD], axis=0)
    return np.asarray((high - low) / 2)


def normal_covariance(y: Array) -> Array:
    """The covariance (k, k) of draws (n, k): sds of `spread`, correlations of normal scores."""
    scores = ndtri((rankdata(y, axis=0) - 0.5) / len(y))
    sd = spread(y)
    return np.asarray(np.atleast_2d(np.corrcoef(scores, rowvar=False)) * np.outer(sd, sd))


class Likelihood:
    """The StateSpace variables of a model with simulated records.

    ``sd`` (k,) is that of the prior in the unconstrained space, of which steps of differences are
    parts. ``on_progress`` is called with the number of new records.
    """

    def __init__(self, model: pm.Model, sd: Array) -> None:
        self._sd = sd
        self.on_progress: Callable[[int], None] = lambda count: None
        self.variables = [ScoredVariable(model, name) for name in state_space_nodes(model)]

    @property
    def n_rows(self) -> int:
        """Rows of a record, of all variables."""
        return sum(len(variable.observed) for variable in self.variables)

    def record(self, x: Array, rng: np.random.Generator) -> list[Array]:
        """A data set (1, J, p) of every variable at a point x (k,), finite if one of some is."""
        drawn = [(variable, variable.simulate(x, N_TRIED, rng)) for variable in self.variables]
        return [found[[np.argmax(_are_finite(variable, found))]] for variable, found in drawn]

    def values(self, x: Array, records: list[Array]) -> Array:
        """The log-likelihood (m,) of one record at points x (m, k); -inf where there is none."""
        total = np.zeros(len(x))
        for variable, observed in zip(self.variables, records, strict=True):
            copies = np.repeat(observed, len(x), axis=0)
            total += variable.terms(variable.theta(x), copies).sum(axis=1)
        return np.where(np.isnan(total), -np.inf, total)

    def gradient(self, x: Array, records: list[Array]) -> Array:
        """The gradient (k,) of the log-likelihood of one record."""
        pairs = zip(self.variables, records, strict=True)
        return np.sum([_row_scores(*pair, x, self._sd).sum(axis=(0, 1)) for pair in pairs], axis=0)

    def information(self, x: Array, count: int, rng: np.random.Generator) -> Array | None:
        """The information (k, k) at x (k,) from so many records; None without a likelihood."""
        total = np.zeros((len(x), len(x)))
        for variable in self.variables:
            products, n_left = np.zeros_like(total), 0
            size = (2 * len(x) + 1) * variable.observed.size
            for part in np.array_split(np.arange(count), -(-count * size // BLOCK_SIZE)):
                drawn = variable.simulate(x, len(part), rng)
                scores = _row_scores(variable, drawn, x, self._sd)
                is_known = (np.abs(scores * self._sd) < HUGE).all(axis=(1, 2))
                scores = scores[is_known & _are_finite(variable, drawn)]
                products += np.einsum("mjx,mjy->xy", scores, scores)
                n_left += len(scores)
            if n_left < LEAST_LEFT * count:
                return None
            total += products / n_left
        self.on_progress(count)
        return total


def _are_finite(variable: ScoredVariable, observed: Array) -> NDArray[np.bool_]:
    """Whether each of data sets (m, J, p) is, which may have exploded; a filter skips NaN."""
    return (np.isfinite(observed) | np.isnan(variable.observed)).all(axis=(1, 2))


def _row_scores(variable: ScoredVariable, observed: Array, x: Array, sd: Array) -> Array:
    """The derivatives (m, J, k_x) of the terms of data sets (m, J, p) at a point x (k_x,)."""
    theta, jacobian = variable.theta(x[None])[0], variable.jacobian(x[None])[0]
    # Those of the system's parameters that depend on x, with steps of their own.
    steps = STEP * np.sqrt(((jacobian * sd) ** 2).sum(axis=-1)).mean(axis=0)
    moving = np.flatnonzero(steps)
    if not moving.size:
        return np.zeros((*observed.shape[:2], len(x)))
    h = steps[moving]
    moves = np.zeros((2, len(moving), len(steps)))
    moves[:, np.arange(len(moving)), moving] = h, -h
    points = theta + moves.reshape(-1, 1, len(steps))
    m = len(observed)
    with np.errstate(invalid="ignore"):  # a difference of infinities
        terms = variable.terms(np.repeat(points, m, axis=0), np.tile(observed, (len(points), 1, 1)))
        up, down = terms.reshape(2, len(moving), m, -1)
        by_theta = (up - down) / (2 * h[:, None, None])
        return np.einsum("imj,jix->mjx", by_theta, jacobian[:, moving][variable.of_rows])


def expected_posterior(cov: Array, information: Array) -> Array:
    """The covariance (k, k) by a prior of covariance ``cov`` and data of this information."""
    sd = np.sqrt(np.diagonal(cov))
    units = np.outer(sd, sd)
    # Of a product with its transpose, which rounding leaves positive definite.
    factor = np.linalg.cholesky(np.linalg.inv(cov / units) + information * units)
    root = sd[:, None] * np.linalg.inv(factor).T
    return np.asarray(root @ root.T)
