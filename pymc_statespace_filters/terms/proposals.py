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

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pymc as pm
import xarray as xr

from ..errors import ModelError
from ..evidence.estimators.student_mixture import flattened_copy
from ..pymc_model.elements import places_in_vector
from ..pymc_model.posterior_draws import unconstrained_draws
from ..statistics.student_mixture import (
    StudentMixture,
    fit_mixture,
    likeliest_mixture,
    standardised,
)
from .coordinates import Coordinates, fitted_coordinates
from .submodel_density import Array, Columns, Sets, SubmodelDensity

MOST_FITTED = 4000  # draws
MOST_COMPONENTS, MIN_GAIN = 6, 0.02  # of the mixture; nats per held-out draw for one more
WIDE = {2.0: 0.2, 4.0: 0.1}  # wide parts of a proposal: their scales, and weights
FIRST = 0.25  # weight of the first proposal in one that was fitted again
N_REFITTED = 4  # components of a mixture fitted to weighted points


@dataclass(frozen=True)
class Proposal:
    """The law of a sub-model's parameters from which points are drawn."""

    present: Sets  # (K,), the terms of the sub-model
    drawn: Columns  # that it has
    mixture: StudentMixture  # of the coordinates of these columns
    first: StudentMixture  # what it was before it was fitted again
    coordinates: Coordinates

    def sample(self, count: int, base: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Points (count, k) and their log-density (count,).

        ``base`` (k,) has values for the columns of absent terms.
        """
        y = np.tile(base, (count, 1))
        drawn = self.mixture.sample(count, rng)
        y[:, self.drawn] = drawn
        x, log_volume = self.coordinates.backward(y, self.drawn)
        return x, self.mixture.log_density(drawn) + log_volume

    def log_density_of_drawn(self, x: Array) -> Array:
        """Log-density (n,) of the coordinates that are drawn from the mixture, at points (n, k)."""
        return self.mixture.log_density(self.coordinates.forward(x)[:, self.drawn])

    def refitted(self, x: Array, log_weights: Array, rng: np.random.Generator) -> "Proposal":
        """Fitted to weighted points of proposals; the same if these have no weights.

        A part of the first proposal stays: points that are few may all be in one region.
        """
        if not self.drawn.size:
            return self
        y = self.coordinates.forward(x)[:, self.drawn]
        copy = flattened_copy(y, log_weights, rng, N_REFITTED)
        if not copy:
            return self
        fit = copy[0].with_wide_parts(WIDE)
        return replace(self, mixture=fit.mixed_with(self.first, FIRST))


class Guide:
    """The posterior of the full model, as proposals of its sub-models need it.

    It is given by unconstrained draws (n, k), and ``values`` (n, k), the same as the variables have
    them; NaN for those whose transform changes shape. Raises `ModelError` if the draws do not vary
    in every direction.
    """

    def __init__(
        self, density: SubmodelDensity, draws: Array, values: Array, rng: np.random.Generator
    ) -> None:
        self.draws = draws
        self._density = density
        candidates = density.candidates.switches
        self._values = candidates.held_at(self.draws.shape[1])
        self._moments = values.mean(axis=0), values.std(axis=0)
        self.coordinates = fitted_coordinates(density, self.draws, values)
        y = self.coordinates.forward(self.draws)
        scaled = self.coordinates.of_values(values, self.draws)
        # The column of the fit on which an absent scalar is conditioned.
        self._given = np.arange(self.draws.shape[1])
        columns = [y]
        for column in np.concatenate(candidates.columns):
            if not np.array_equal(values[:, column], self.draws[:, column]):
                self._given[column] = self.draws.shape[1] + len(columns) - 1
                columns.append(scaled[:, column, None])
        self._mixture = _fitted(np.concatenate(columns, axis=1), rng)
        self._slopes = self._slopes_of_priors(y)

    @classmethod
    def of_draws(
        cls, density: SubmodelDensity, idata: xr.DataTree, rng: np.random.Generator
    ) -> "Guide":
        """From the posterior group."""
        every = unconstrained_draws(idata, density.model)
        thin = slice(None, None, -(-every.shape[0] * every.shape[1] // MOST_FITTED))
        posterior = {
            rv.name: idata["posterior"][rv.name].transpose("chain", "draw", ...).values[:, thin]
            for rv in density.model.free_RVs
        }
        flat = {name: np.concatenate(list(one)) for name, one in posterior.items()}
        draws = every[:, thin].reshape(-1, every.shape[-1])
        return cls(density, draws, _in_columns(flat, density.model), rng)

    @classmethod
    def of_points(cls, density: SubmodelDensity, x: Array, rng: np.random.Generator) -> "Guide":
        """From points (n, k) of the full model."""
        is_on = np.ones((len(x), len(density.candidates)), dtype=bool)
        values = density.density.constrained(density.model.free_RVs)(x, is_on)
        return cls(density, x, _in_columns(values, density.model), rng)

    @property
    def base(self) -> Array:
        """A point (k,) in the middle of the draws."""
        return np.asarray(np.median(self.draws, axis=0))

    @property
    def distances(self) -> Array:
        """How far the terms are from vanishing, in standard deviations of the draws, (K,)."""
        of_columns = np.abs(self._moments[0] - self._values) / self._moments[1]
        columns = self._density.candidates.switches.columns
        return np.array([of_columns[one].max() for one in columns])

    def proposal(self, present: Sets) -> Proposal:
        """The mixture given that the terms of a sub-model that are absent vanish."""
        drawn = self._density.columns_of(present)
        absent = np.setdiff1d(np.arange(self.draws.shape[1]), drawn)
        mixture = self._mixture.conditioned(drawn, self._given[absent], self._values[absent])
        mixture = mixture.tilted(-self._slopes[~present].sum(axis=0)[drawn])
        wider = mixture.with_wide_parts(WIDE)
        return Proposal(present, drawn, wider, wider, self.coordinates)

    def _slopes_of_priors(self, y: Array) -> Array:
        """How the log prior densities of absent terms change with other coordinates, (K, k).

        By linear regression on those of the draws (n, k). Conditioning a coordinate takes care of a
        part of it.
        """
        log_prior = self._density.log_prior_held(self.draws) * (
            1 - self.coordinates.power_of_values
        )
        slopes = np.zeros((len(self._density.candidates), y.shape[1]))
        columns = self._density.candidates.switches.columns
        for slope, values in zip(slopes, (log_prior[:, one] for one in columns), strict=True):
            h = values.sum(axis=1)
            if np.isfinite(h).all() and np.ptp(h) > 0:
                slope[:] = _slope(y, h)
        return slopes


def _slope(x: Array, values: Array) -> Array:
    """The coefficients (k,) of a ridge regression of values (n,) on x (n, k)."""
    scale = x.std(axis=0)
    z = (x - x.mean(axis=0)) / scale
    ridge = z.T @ z + np.eye(x.shape[1])
    return np.asarray(np.linalg.solve(ridge, z.T @ (values - values.mean())) / scale)


def _in_columns(values: Mapping[str, np.ndarray], model: pm.Model) -> Array:
    """Values (n, ...) of the free variables side by side, (n, k).

    NaN for those whose transform changes shape.
    """
    parts = []
    for name, at in places_in_vector(model).items():
        flat = values[name].reshape(len(values[name]), -1)
        same = flat.shape[1] == at.size
        parts.append(flat if same else np.full((len(flat), at.size), np.nan))
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
    numbers = range(1, MOST_COMPONENTS + 1)
    best = likeliest_mixture(first, second, numbers, rng, least_gain=MIN_GAIN)
    return fit_mixture(found.z, best).affine(found.mean, found.chol)
