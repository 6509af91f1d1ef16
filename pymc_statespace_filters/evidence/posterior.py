"""The posterior as estimators see it: unconstrained draws, log-densities and the prior.

Log-densities on the unconstrained space include the Jacobians of the transforms.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import DataMismatchError, ModelError
from ..filters.outcomes import Failure, why_zero
from ..importance import LogMean, log_mean_of_draws, mcse

N_EXPLAINED = 100  # points of zero likelihood at which the reason is looked for
LEAST_POPULATIONS = 4  # two in each half, whose spread is its error
LEAST_SHARE = 0.02  # of the draws, for a population to count
LEAST_HALF = 0.25  # of the draws

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
    failures : callable, optional
        ``failures(x)`` counts why the likelihood is zero at points x (m, k).
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
    failures: Callable[[Array], Counter[Failure]] | None = None
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

    def worst_disagreement(self, found: Iterable[str]) -> list[str]:
        """The worst of what chains disagree about, if they are chains; those that agree are ""."""
        if self.population is not None:
            return []
        return sorted({one for one in found if one})[-1:]

    def mcse(self, terms: Array) -> float:
        """Standard error of the mean of terms (chain, draw), one of each draw."""
        return mcse(terms, self.population)

    def ess(self, terms: Array) -> float:
        """How many independent draws the mean of terms (chain, draw) is worth, at least one."""
        if self.population is not None:
            error = self.mcse(terms)
            return max(1.0, float(terms.var()) / error**2) if error > 0 else float(terms.size)
        from arviz_stats import ess  # loads much: see `importance`

        return float(ess(terms, method="mean"))

    def log_mean(self, log_terms: Array) -> LogMean:
        """Log of the mean of positive terms (chain, draw), one of each draw, with its error."""
        return log_mean_of_draws(log_terms, self.population)

    def why_zero(self, x: Array) -> str:
        """Why the likelihood is zero at most of some prior draws x (m, k), and what to do."""
        x = x[:N_EXPLAINED]
        return why_zero(Counter() if self.failures is None else self.failures(x), len(x))

    def halves(self) -> tuple["Posterior", "Posterior"]:
        """Split every chain into its first and second half; of populations, half of these.

        Each half can be averaged, with an error of its own.

        Raises
        ------
        ModelError
            If fewer than four populations have a fiftieth of the draws or more, or one decides,
            so that either half has less than a quarter of the draws.
        """
        if self.population is not None:
            return self._halves_of_populations(self.population)
        return self._halves_of_chains()

    def halves_for_fit(self) -> tuple["Posterior", "Posterior"]:
        """Split every chain into its first and second half; of populations, every second draw.

        A fit to one half is compared with the other. Nothing is averaged, so that one population
        is enough.
        """
        if self.population is not None:
            return self.at(np.s_[:, ::2]), self.at(np.s_[:, 1::2])
        return self._halves_of_chains()

    def _halves_of_chains(self) -> tuple["Posterior", "Posterior"]:
        middle = self.draws.shape[1] // 2
        return self.at(np.s_[:, :middle]), self.at(np.s_[:, middle:])

    def _halves_of_populations(
        self, population: NDArray[np.int64]
    ) -> tuple["Posterior", "Posterior"]:
        """The populations dealt out in the order of their sizes, each half as one chain."""
        labels, sizes = np.unique(population, return_counts=True)
        order = labels[np.argsort(-sizes, kind="stable")]
        is_first = np.isin(population, [*order[::4], *order[3::4]])
        n_counting = int((sizes >= LEAST_SHARE * population.size).sum())
        share = min(is_first.mean(), 1 - is_first.mean())
        if n_counting < LEAST_POPULATIONS or share < LEAST_HALF:
            raise ModelError(
                f"the draws of idata must be of at least {LEAST_POPULATIONS} populations, none of "
                f"which decides alone, to be averaged, got {n_counting} with {LEAST_SHARE:.0%} of "
                f"the draws or more, and {sizes.max() / population.size:.0%} in the largest: use "
                'estimate_evidence with estimators="importance", or raise draws or populations of '
                "sample_smc"
            )
        first, second = (np.nonzero(mask) for mask in (is_first, ~is_first))
        return self.at(tuple(one[None] for one in first)), self.at(
            tuple(one[None] for one in second)
        )

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
