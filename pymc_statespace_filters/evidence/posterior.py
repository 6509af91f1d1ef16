"""The posterior as estimators see it: unconstrained draws, log-densities and the prior.

Log-densities on the unconstrained space include the Jacobians of the transforms.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import DataMismatchError

Array = NDArray[np.float64]


class Prior(Protocol):
    """The prior of the free variables on the unconstrained space, Jacobians included."""

    def log_density(self, x: Array) -> Array:
        """Log-density of points x (m, k), shape (m,); normalised if the priors are."""

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Independent draws, shape (count, k); `ModelError` if the prior cannot be sampled."""


@dataclass(frozen=True)
class Posterior:
    """Draws of a posterior with their log-densities, and functions to evaluate further points.

    Attributes
    ----------
    draws : ndarray (chain, draw, k)
        Unconstrained.
    log_density : ndarray (chain, draw)
        Log prior + log likelihood + log Jacobian of each draw. With a noisy likelihood these are
        the estimates by which the chain accepted the draws; fresh ones cannot replace them.
    evaluate : callable
        ``evaluate(x, rng)`` returns the log-densities (m,) of points x (m, k), never NaN; a noisy
        likelihood takes fresh noise from `rng` for each point.
    is_noisy : bool
        Whether repeated evaluations at one point differ.
    prior : Prior, optional
        The likelihood is the log-density of `evaluate` minus that of the prior.
    population : ndarray of int (chain, draw), optional
        The population of each draw, if they are particles: see `are_populations`. The draws of one
        have common ancestors, so that only populations are independent.
    remedy : str
        What else may help where proposals that are fitted to the draws are poor.
    shared_seed : tuple of int, optional
        Seed of the points whose log-densities several estimators use. Without it each estimator
        evaluates points of its own.
    shared : dict
        These points; empty at first, and in every copy.
    """

    draws: Array
    log_density: Array
    evaluate: Callable[[Array, np.random.Generator], Array]
    is_noisy: bool = False
    prior: Prior | None = None
    population: NDArray[np.int64] | None = None
    remedy: str = "use bridge sampling"
    shared_seed: tuple[int, ...] | None = None
    shared: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def required_prior(self) -> Prior:
        """The prior, for estimators that cannot do without it."""
        assert self.prior is not None, "a posterior without a prior"
        return self.prior

    def evaluate_factors(self, x: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Log prior and log-likelihood of points x (m, k), each of shape (m,).

        A noisy likelihood is estimated with fresh noise for each point.
        """
        log_prior = self.required_prior.log_density(x)
        return log_prior, log_likelihood_of(self.evaluate(x, rng), log_prior)

    def halves(self) -> tuple["Posterior", "Posterior"]:
        """Split every chain into its first and second half; each has an error of its own."""
        middle = self.draws.shape[1] // 2
        return self.at(np.s_[:, :middle]), self.at(np.s_[:, middle:])

    def halves_for_fit(self) -> tuple["Posterior", "Posterior"]:
        """The same, and of populations every second draw: a fit to one is tried on the other."""
        if self.population is None:
            return self.halves()
        return self.at(np.s_[:, ::2]), self.at(np.s_[:, 1::2])

    def thinned(self, most: int) -> "Posterior":
        """Thin every chain evenly, so that about `most` draws remain in all, or fewer."""
        return self.every(-(-self.log_density.size // most))

    def every(self, step: int) -> "Posterior":
        """One of so many draws of every chain."""
        return self.at(np.s_[:, ::step])

    def at(self, index: Any) -> "Posterior":
        """The draws at an index of the axes chain and draw."""
        population = None if self.population is None else self.population[index]
        return replace(
            self,
            draws=self.draws[index],
            log_density=self.log_density[index],
            population=population,
        )


def log_likelihood_of(log_density: Array, log_prior: Array) -> Array:
    """Log-density minus log prior; -inf wherever the log-density is -inf."""
    finite = np.isfinite(log_density)
    return np.subtract(log_density, log_prior, out=np.full_like(log_density, -np.inf), where=finite)


def check_overlap(log_density: Array) -> None:
    """Raise a `DataMismatchError` if the density of a model is zero at all proposals (m,)."""
    if np.isneginf(log_density).all():
        raise DataMismatchError(
            f"all {len(log_density)} proposals around the draws have zero density: idata belongs "
            "to another model or to other data"
        )
