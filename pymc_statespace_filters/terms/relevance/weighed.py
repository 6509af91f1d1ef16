"""The true density under optimised priors, by importance sampling from the fitted mixture."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from ...compiler.native.rows import Rows
from ...evidence.estimators.student_mixture import flattened_copy
from ...evidence.posterior import check_overlap
from ...importance import (
    MIN_EFFECTIVE,
    LogMean,
    largest_good_k,
    log_mean_of_independent,
    normalised,
    pareto_k,
)
from ...pymc_model.switched_density import SwitchedDensity, Switches
from ...student_mixture import WIDE_SCALE, WIDE_WEIGHT, StudentMixture
from .chosen_terms import ChosenTerms

N_POINTS = 2000
N_REFITS, N_COMPONENTS = 6, 2  # of the proposals, where they do not fit

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Weighed:
    """Points of a posterior with weights.

    Attributes
    ----------
    evidence : LogMean
    tail : float
        Pareto shape of the weights.
    mean, sd : ndarray (p,)
        Of the coefficients; zero where a term is absent.
    """

    evidence: LogMean
    tail: float
    mean: Array
    sd: Array

    def doubts(self) -> Iterator[str]:
        """Why the evidence may be wrong by more than its error."""
        n_effective = self.evidence.kish_ess(N_POINTS)
        if n_effective < MIN_EFFECTIVE or not self.tail <= largest_good_k(N_POINTS):
            yield (
                "the normal mixture fitted to the draws does not follow the posterior there "
                f"(Pareto k {self.tail:.2f}, {n_effective:.0f} effective points)"
            )


class TermDensity:
    """The density of a model with other priors of its coefficients, at many points."""

    def __init__(self, terms: ChosenTerms) -> None:
        self._columns = terms.columns
        each = tuple(np.array([column]) for column in terms.columns)
        switches = Switches(each, (np.zeros(1),) * len(each))
        self._density = SwitchedDensity(terms.model, switches)
        self._own = self._density.blocks[terms.columns]

    @property
    def calls(self) -> Rows:
        """What reports the progress of evaluations."""
        return self._density.calls

    def at_draws(self, x: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Log-densities (m,) at draws x (m, k) of the model, and log priors (m, p) of its terms."""
        return self._evaluate(x, np.ones(len(self._columns), dtype=bool), rng)

    def weigh(self, proposals: StudentMixture, sd: Array, rng: np.random.Generator) -> Weighed:
        """Weigh points of a density for the posterior under priors N(0, sd^2) of the coefficients.

        ``sd`` (p,) is zero where a term is absent. A point has the coefficients that are present,
        then all other parameters.
        """
        for _ in range(N_REFITS + 1):
            points, log_weights = self._points(proposals, sd, rng)
            found = _weighed(log_weights, points[:, : (sd > 0).sum()], sd)
            if not any(found.doubts()):
                break
            fit = flattened_copy(points, log_weights, rng, N_COMPONENTS)
            if not fit:
                break
            proposals = fit[0].with_wide_parts({WIDE_SCALE: WIDE_WEIGHT})
        return found

    def _points(
        self, proposals: StudentMixture, sd: Array, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Points and their log-weights."""
        present = sd > 0
        points = proposals.sample(N_POINTS, rng)
        x = np.zeros((N_POINTS, points.shape[1] + int((~present).sum())))
        shown = self._columns[present]
        others = np.setdiff1d(np.arange(x.shape[1]), self._columns)
        x[:, np.concatenate([shown, others])] = points
        log_density, own = self._evaluate(x, present, rng)
        check_overlap(log_density)
        possible = np.isfinite(log_density)
        log_density[possible] -= own[possible][:, present].sum(axis=1)
        log_density += norm.logpdf(x[:, shown], scale=sd[present]).sum(axis=1)
        return points, log_density - proposals.log_density(points)

    def _evaluate(
        self, x: Array, present: NDArray[np.bool_], rng: np.random.Generator
    ) -> tuple[Array, Array]:
        n_seeds = len(self._density.seed_names)
        seeds = rng.integers(np.iinfo(np.int64).max, size=(len(x), n_seeds))
        is_on = np.broadcast_to(present, (len(x), len(present)))
        found = self._density.evaluate_in_parts(x, is_on, seeds)
        return found.total, found.own[:, self._own]


def _weighed(log_weights: Array, coefficients: Array, prior_sd: Array) -> Weighed:
    """Moments of the coefficients that are present, with the prior's sd above zero."""
    weights, present = normalised(log_weights), prior_sd > 0
    mean, sd = np.zeros((2, len(prior_sd)))
    mean[present] = weights @ coefficients
    sd[present] = np.sqrt(weights @ (coefficients - mean[present]) ** 2)
    return Weighed(log_mean_of_independent(log_weights), pareto_k(log_weights), mean, sd)
