"""Posteriors of simulated records by importance sampling, which are not taken to be normal."""

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from ..pymc_model.at_points import GraphsAtPoints
from ..pymc_model.inspection import log_density_graph
from ..statistics.importance import largest_good_k, normalised, smoothed, systematic
from ..statistics.student_mixture import StudentMixture, mixture_of
from .fisher_information import Coordinates, Likelihood, spread

N_DRAWS, N_ROUNDS = 2000, 6  # of importance samples, each with proposals fitted to the one before
N_COMPONENTS = 4  # of proposals: a posterior may be bent
WIDE = {2.0: 0.2}  # scales of further components, with their weights
# Effective share of the draws that a sample has at least; and from which its tail may be any.
LEAST, ENOUGH = 0.2, 0.5
N_NEWTON, N_HALVINGS, SETTLED = 20, 6, 1e-3  # SETTLED in nats
STEP = 1e-3  # of differences of the prior, in standard deviations of the posterior

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
        self._log_density_of_x = GraphsAtPoints(
            model, [log_density_graph(model, model.free_RVs)], point
        )

    def spread(self, x: Array, cov: Array, rng: np.random.Generator) -> Array | None:
        """Of the posterior of a record simulated at x (k,), by `spread` in the coordinates, (k,).

        ``cov`` (k, k) is the expected covariance of the coordinates. None if importance sampling
        fails.
        """
        records = self._likelihood.record(x, rng)
        mode = self._mode(self._coordinates(x[None])[0], cov, records)
        proposal = StudentMixture(np.ones(1), mode[None], np.linalg.cholesky(cov)[None])
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
                return spread(draws)
            fitted = mixture_of(draws, N_COMPONENTS, rng)
            if fitted is None:
                return None
            proposal = fitted
        return None

    def _log_density(self, y: Array, records: list[Array]) -> Array:
        """The log-density (m,) of the posterior at coordinates y (m, k), -inf outside."""
        found = self._log_prior(y)
        inside = np.isfinite(found)
        if inside.any():
            x = self._coordinates.inverse(y[inside])
            found[inside] += self._likelihood.values(x, records)
        return found

    def _log_prior(self, y: Array) -> Array:
        with np.errstate(all="ignore"):
            x = self._coordinates.inverse(y)
            (found,) = self._log_density_of_x(x)
            found = found - np.linalg.slogdet(self._coordinates.jacobian(x, self._sd))[1]
        return np.where(np.isfinite(found), found, -np.inf)

    def _mode(self, y: Array, cov: Array, records: list[Array]) -> Array:
        """The mode (k,), by steps from y with the expected covariance, which climb."""
        value = self._log_density(y[None], records)[0]
        for _ in range(N_NEWTON):
            step = cov @ (self._slope(y, records) + self._prior_slope(y, cov))
            tried = y + step / 2.0 ** np.arange(N_HALVINGS)[:, None]
            values = self._log_density(tried, records)
            best = int(values.argmax())
            if not values[best] > value + SETTLED:
                break
            y, value = tried[best], values[best]
        return y

    def _slope(self, y: Array, records: list[Array]) -> Array:
        """The gradient (k,) of the log-likelihood by the coordinates."""
        x = self._coordinates.inverse(y[None])
        (jacobian,) = self._coordinates.jacobian(x, self._sd)
        return np.linalg.solve(jacobian.T, self._likelihood.gradient(x[0], records))

    def _prior_slope(self, y: Array, cov: Array) -> Array:
        h = STEP * np.sqrt(np.diagonal(cov))
        up, down = (self._log_prior(y + sign * np.diag(h)) for sign in (1, -1))
        return np.asarray((up - down) / (2 * h))
