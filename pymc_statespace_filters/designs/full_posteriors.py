"""Posteriors of simulated records by importance sampling, which are not taken to be normal."""

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from ..pymc_model.at_points import GraphsAtPoints
from ..statistics.importance import largest_good_k, normalised, smoothed, systematic
from ..statistics.student_mixture import StudentMixture, mixture_of
from .fisher_information import Coordinates, Likelihood, spread

N_DRAWS = 2000  # of each importance sample
ENOUGH = 0.5  # effective share of the draws, from which the shape of the tail is of no interest
N_FIRST = 1000  # of those that find the shape of the proposals
N_COMPONENTS = 4
WIDE = {2.0: 0.2}  # scales of further components, with their weights
N_NEWTON, N_HALVINGS, SETTLED = 20, 6, 1e-3  # SETTLED in nats
STEP = 1e-4  # of differences of the prior, in standard deviations

Array = NDArray[np.float64]


class FullPosterior:
    """The posteriors of records at points of a model's unconstrained space.

    ``sd`` (k,) is that of the prior there.
    """

    def __init__(
        self, model: pm.Model, likelihood: Likelihood, coordinates: Coordinates, sd: Array
    ) -> None:
        self._likelihood, self._coordinates, self._sd = likelihood, coordinates, sd
        start = model.initial_point()
        values = [model.rvs_to_values[rv] for rv in model.free_RVs]
        point = {value: start[value.name] for value in values}
        self._log_prior = GraphsAtPoints(model, [model.logp(vars=model.free_RVs)], point)

    def spread(self, x: Array, cov: Array, rng: np.random.Generator) -> Array | None:
        """Of the posterior of a record simulated at x (k,), by `spread` in the coordinates, (k,).

        ``cov`` (k, k) is the expected covariance of the coordinates. None if importance sampling
        fails.
        """
        records = self._likelihood.simulate(x, 1, rng)
        inverse = np.linalg.inv(self._coordinates.jacobian(x, self._sd))
        own = inverse @ cov @ inverse.T
        mode = self._mode(x, own, records)
        proposal = StudentMixture(np.ones(1), mode[None], np.linalg.cholesky(own)[None])
        for count in (N_FIRST, N_FIRST, N_DRAWS):
            proposal = proposal.with_wide_parts(WIDE)
            draws = proposal.sample(count, rng)
            log_weights = self._log_density(draws, records) - proposal.log_density(draws)
            if not np.isfinite(log_weights).any():
                return None
            log_weights, pareto_k = smoothed(log_weights)
            weights = normalised(log_weights)
            draws = draws[systematic(weights, count, rng)]
            if (fitted := mixture_of(draws, N_COMPONENTS, rng)) is None:
                return None
            proposal = fitted
        self._likelihood.on_progress(1)
        # A tail of nearly equal weights may have any shape.
        if pareto_k > largest_good_k(N_DRAWS) and (weights**2).sum() > 1 / (ENOUGH * N_DRAWS):
            return None
        return spread(self._coordinates(draws))

    def _log_density(self, x: Array, records: list[Array]) -> Array:
        """The log-density (m,) of the posterior at x (m, k), -inf where there is none."""
        with np.errstate(all="ignore"):
            found = self._log_prior(x)[0] + self._likelihood.values(x, records)
        return np.where(np.isnan(found), -np.inf, found)

    def _mode(self, x: Array, cov: Array, records: list[Array]) -> Array:
        """The mode (k,), by steps from x with the expected covariance, which climb."""
        value = self._log_density(x[None], records)[0]
        for _ in range(N_NEWTON):
            step = cov @ (self._likelihood.gradient(x, records) + self._prior_gradient(x))
            tried = x + step / 2.0 ** np.arange(N_HALVINGS)[:, None]
            values = self._log_density(tried, records)
            best = int(values.argmax())
            if not values[best] > value + SETTLED:
                break
            x, value = tried[best], values[best]
        return x

    def _prior_gradient(self, x: Array) -> Array:
        moves = STEP * np.diag(self._sd)
        up, down = (self._log_prior(x + sign * moves)[0] for sign in (1, -1))
        return np.asarray((up - down) / (2 * STEP * self._sd))
