"""Posteriors of simulated records by importance sampling, which are not taken to be normal."""

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from ..pymc_model.at_points import GraphsAtPoints
from ..statistics.importance import largest_good_k, normalised, smoothed, systematic
from ..statistics.student_mixture import StudentMixture, mixture_of
from .fisher_information import Coordinates, Likelihood, spread

N_DRAWS, N_ROUNDS = 2000, 8  # of importance samples, each with proposals fitted to the one before
N_COMPONENTS = 8  # of proposals: a posterior may be a narrow, bent ridge
WIDE = {2.0: 0.2}  # scales of further components, with their weights
# Effective share of the draws that a sample has at least; and from which its tail may be any.
LEAST, ENOUGH = 0.3, 0.5
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
        records = self._likelihood.record(x, rng)
        inverse = np.linalg.inv(self._coordinates.jacobian(x, self._sd))
        own = inverse @ cov @ inverse.T
        mode = self._mode(x, own, records)
        proposal = StudentMixture(np.ones(1), mode[None], np.linalg.cholesky(own)[None])
        for _ in range(N_ROUNDS):
            proposal = proposal.with_wide_parts(WIDE)
            draws = proposal.sample(N_DRAWS, rng)
            log_weights = self._log_density(draws, records) - proposal.log_density(draws)
            if not np.isfinite(log_weights).any():
                return None
            log_weights, pareto_k = smoothed(log_weights)
            weights = normalised(log_weights)
            share = 1 / (weights**2).sum() / N_DRAWS
            draws = draws[systematic(weights, N_DRAWS, rng)]
            if share > (LEAST if pareto_k <= largest_good_k(N_DRAWS) else ENOUGH):
                self._likelihood.on_progress(1)
                return spread(self._coordinates(draws))
            fitted = mixture_of(draws, N_COMPONENTS, rng)
            if fitted is None:
                return None
            proposal = fitted
        return None

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
