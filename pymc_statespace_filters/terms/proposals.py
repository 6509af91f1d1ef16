"""Densities from which the parameters of sub-models are drawn.

The posterior of a sub-model is near that of the full model given that its absent terms vanish. A
Student mixture is fitted to draws of the full model, and conditioned on the values at which the
terms vanish. A quantity that has a transform is in it twice, transformed and as it is: zero has no
logarithm, so that a sub-model without the term is conditioned on the value, while one that has it
draws the logarithm. Where the prior of an absent term depends on other variables, as on the scale
of all slabs, its density at that value is no part of the sub-model: to first order it is divided
out. A wide part bounds the weights in the tails. Whatever is fitted is a proper
density: it decides the error of an evidence, and not its mean.
"""

from dataclasses import dataclass

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ..errors import ModelError
from ..evidence.estimators.student_mixture import flattened_copy
from ..pymc_model.posterior_draws import unconstrained_draws
from ..student_mixture import StudentMixture, fit_mixture, place_components, standardised
from .density import Array, Columns, Point, Sets, SubmodelDensity

MOST_FITTED = 4000  # draws
MOST_COMPONENTS, MIN_GAIN = 6, 0.02  # of the mixture; nats per held-out draw for one more
WIDE_WEIGHT, WIDE_SCALE = 0.1, 2.0
N_REGRESSED = 200  # draws, of prior densities on other variables
N_REFITTED = 4  # components of a mixture fitted to weighted points


@dataclass(frozen=True)
class Proposal:
    """The law of a sub-model's parameters from which points are drawn.

    Attributes
    ----------
    present : ndarray of bool (K,)
        The terms of the sub-model.
    drawn, unused : ndarray of int
        Columns drawn from the mixture, and from the prior.
    unused_blocks : ndarray of bool (blocks,)
    mixture : StudentMixture
        Of the columns ``drawn``.
    """

    present: Sets
    drawn: Columns
    unused: Columns
    unused_blocks: NDArray[np.bool_]
    mixture: StudentMixture

    def sample(
        self, count: int, base: Array, pool: Array, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Points (count, k) and their log-density without that of unused variables, (count,).

        ``base`` (k,) has values for the columns of absent terms, and ``pool`` (m, k) draws of the
        prior.
        """
        x = np.tile(base, (count, 1))
        x[:, self.drawn] = self.mixture.sample(count, rng)
        x[:, self.unused] = pool[rng.integers(len(pool), size=count)][:, self.unused]
        return x, self.mixture.log_density(x[:, self.drawn])

    def refitted(self, x: Array, log_weights: Array, rng: np.random.Generator) -> "Proposal":
        """Fitted to weighted points of this one; the same if these have no weights."""
        if not self.drawn.size:
            return self
        copy = flattened_copy(x[:, self.drawn], log_weights, rng, N_REFITTED)
        if not copy:
            return self
        mixture = copy[0].with_wide_part(WIDE_WEIGHT, WIDE_SCALE)
        return Proposal(self.present, self.drawn, self.unused, self.unused_blocks, mixture)


class Guide:
    """The posterior of the full model, as proposals of its sub-models need it.

    Attributes
    ----------
    draws : ndarray (n, k)
        Unconstrained.

    Raises
    ------
    ModelError
        If the draws do not vary in every direction.
    """

    def __init__(
        self, density: SubmodelDensity, idata: xr.DataTree, rng: np.random.Generator
    ) -> None:
        every = unconstrained_draws(idata, density.model)
        thin = slice(None, None, -(-every.shape[0] * every.shape[1] // MOST_FITTED))
        self.draws = every[:, thin].reshape(-1, every.shape[-1])
        self._density = density
        candidates = density.candidates.switches
        values = _values_of(idata, density.model, thin)
        self._values = candidates.held_at(self.draws.shape[1])
        # The column of the fit on which an absent scalar is conditioned.
        self._given = np.arange(self.draws.shape[1])
        columns = [self.draws]
        for column in np.concatenate(candidates.columns):
            if not np.array_equal(values[:, column], self.draws[:, column]):
                self._given[column] = self.draws.shape[1] + len(columns) - 1
                columns.append(values[:, column, None])
        self._mixture = _fitted(np.concatenate(columns, axis=1), rng)
        self._slopes = self._slopes_of_priors(rng)

    @property
    def base(self) -> Array:
        """A point (k,) in the middle of the draws."""
        return np.asarray(np.median(self.draws, axis=0))

    def proposal(self, present: Sets, unused_blocks: NDArray[np.bool_]) -> Proposal:
        """The mixture given that the terms of a sub-model that are absent vanish."""
        has = self._density.columns_of(present)
        is_unused = unused_blocks[self._density.blocks[has]]
        drawn, unused = has[~is_unused], has[is_unused]
        absent = np.setdiff1d(np.arange(self.draws.shape[1]), has)
        mixture = self._mixture.conditioned(drawn, self._given[absent], self._values[absent])
        mixture = mixture.tilted(-self._slopes[~present].sum(axis=0)[drawn])
        wider = mixture.with_wide_part(WIDE_WEIGHT, WIDE_SCALE)
        blocks = np.isin(np.arange(len(unused_blocks)), self._density.blocks[unused])
        return Proposal(present, drawn, unused, blocks, wider)

    def _slopes_of_priors(self, rng: np.random.Generator) -> Array:
        """How the log prior densities of absent terms change with other variables, (K, k).

        By linear regression at some draws.
        """
        n = len(self._density.candidates)
        x = self.draws[rng.permutation(len(self.draws))[:N_REGRESSED]]
        seeds = self._density.fresh_seeds(len(x), rng)
        held = self._density.evaluate(Point(x, np.zeros((len(x), n), dtype=bool), seeds)).held
        columns = self._density.candidates.switches.columns
        of_terms = [held[:, np.unique(self._density.blocks[one])].sum(axis=1) for one in columns]
        slopes = np.zeros((n, x.shape[1]))
        for slope, values in zip(slopes, of_terms, strict=True):
            if np.isfinite(values).all() and np.ptp(values) > 0:
                slope[:] = _slope(x, values)
        return slopes


def _slope(x: Array, values: Array) -> Array:
    """The coefficients (k,) of a ridge regression of values (n,) on x (n, k)."""
    scale = x.std(axis=0)
    z = (x - x.mean(axis=0)) / scale
    ridge = z.T @ z + np.eye(x.shape[1])
    return np.asarray(np.linalg.solve(ridge, z.T @ (values - values.mean())) / scale)


def _values_of(idata: xr.DataTree, model: pm.Model, thin: slice) -> Array:
    """The draws (n, k) as the variables have them; NaN for those whose transform changes shape."""
    posterior, start, parts = idata["posterior"], model.initial_point(), []
    for rv in model.free_RVs:
        size = start[model.rvs_to_values[rv].name].size
        drawn = posterior[rv.name].transpose("chain", "draw", ...).values[:, thin]
        flat = drawn.reshape(drawn.shape[0] * drawn.shape[1], -1)
        same = flat.shape[1] == size
        parts.append(flat if same else np.full((len(flat), size), np.nan))
    return np.concatenate(parts, axis=1, dtype=np.float64)


def _fitted(x: Array, rng: np.random.Generator) -> StudentMixture:
    """The mixture of draws (n, k) whose held-out density is largest."""
    found = standardised(x)
    if found is None:
        raise ModelError(
            "the draws of idata must vary in every direction, and differ from each other: give "
            "more draws of the full model"
        )
    half = rng.permutation(len(x))
    first, second = found.z[half[::2]], found.z[half[1::2]]
    best, reached = place_components(first, 1, rng), -np.inf
    for n_components in range(1, MOST_COMPONENTS + 1):
        fit = fit_mixture(first, place_components(first, n_components, rng))
        score = float(fit.log_density(second).mean())
        if score < reached + MIN_GAIN:
            break
        best, reached = fit, score
    return fit_mixture(found.z, best).affine(found.mean, found.chol)
