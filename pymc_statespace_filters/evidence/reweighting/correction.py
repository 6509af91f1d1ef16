"""Draws of an approximate posterior, weighted to represent the exact one."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from ...statistics.importance import MIN_EFFECTIVE, normalised, smoothed, systematic
from ..estimators.student_mixture import choose_mixture
from ..exact_density import ExactDensity, fresh_seeds
from ..pooled import Pooled
from ..posterior import Posterior, check_overlap
from .defence import N_ROUNDS, N_SEARCHED, defensive_mixture

FEWEST_POINTS = 200
POINTS_PER_DRAW = 0.25
# Draws and seeds with which the noise of an estimate is measured.
N_MEASURED, N_MEASURING = 16, 8
MOST_SEEDS = 16
# Relative variance that the noise of the averaged estimates of a point may have; it is one where
# half of the effective draws are lost.
MAX_NOISE = 1.0
# Estimates at the draws that are weighted unless their number is given; at those that only say
# where an evidence is; and the fewest of these draws.
MOST_ESTIMATES, MOST_GUIDING, FEWEST_GUIDING = 32_000, 4000, 500
MOST_DRAWS = 1000  # that are weighted for an evidence
BEYOND = 0.01  # share of the corrected draws that lie further out than all others

Array = NDArray[np.float64]
Seeds = NDArray[np.int64]
Evaluate = Callable[[Array, Seeds], Array]


@dataclass(frozen=True)
class Correction:
    """Draws and defensive points with their weights for the exact posterior."""

    x: Array  # (n + m, k), the n draws, chain by chain, and m defensive points
    seeds: Seeds  # (n + m, r, v), of the r estimates of a point, for each of v variables
    log_estimates: Array  # (n + m, r), of the log-density of the exact posterior
    pooled: Pooled  # weights for the mean of the estimates
    log_fit: Array  # (n + m,), log-density of the mixture fitted to the draws

    @cached_property
    def weights(self) -> Array:
        """Pareto-smoothed weights (n + m,) of sum one."""
        return normalised(smoothed(self.pooled.log_weights)[0])

    @property
    def spread(self) -> float:
        """Standard deviation of the log weights of the draws, those of zero left out."""
        log_weights = self.pooled.log_draw_weights
        return float(log_weights[np.isfinite(log_weights)].std())

    @cached_property
    def beyond_draws(self) -> tuple[float, float]:
        """The share of the exact posterior where there are no draws, and its standard error.

        By the defensive points alone, weighted by their own density: further out, in terms of the
        density fitted to the draws, than all but a hundredth of the corrected draws.
        """
        n = self.pooled.n_draws
        level = _weighted_quantile(self.log_fit[:n], self.pooled.log_draw_weights.ravel(), BEYOND)
        weights = normalised(self.pooled.log_target[n:] - self.pooled.log_q[n:])
        outside = self.log_fit[n:] < level
        share = float(weights @ outside)
        error = float(np.sqrt(weights**2 @ (outside - share) ** 2))
        return max(share - BEYOND, 0.0), error

    def resampled(self, rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Numbers of points (chain, draw) by their smoothed weights, and of an estimate of each.

        Copies of a point are neighbours, and draws keep their order, with the defensive points
        spread evenly among them: the autocorrelation that ArviZ finds counts the copies as well as
        the chain's own. Of several estimates of a point one is chosen with the probability that is
        its share of their sum: the point and its seed then have their joint posterior.
        """
        n, m = self.pooled.n_draws, len(self.x) - self.pooled.n_draws
        place = np.concatenate([np.arange(n), (np.arange(m) + 0.5) * n / m - 0.5])
        order = np.argsort(place, kind="stable")
        index = order[systematic(self.weights[order], n, rng)].reshape(self.pooled.shape)
        logs = self.log_estimates[index]
        return index, (logs + rng.gumbel(size=logs.shape)).argmax(axis=-1)


def correct(
    posterior: Posterior,
    kept: Posterior,
    evaluate: Evaluate,
    seeds_of_point: tuple[int, int],
    rng: np.random.Generator,
    announce: Callable[[str, int], None] = lambda task, total: None,
) -> Correction:
    """Weight draws of an approximate posterior, and points that defend against what they miss.

    The draws of ``kept``, some of the posterior's, are weighted. ``evaluate(x, seeds)`` estimates
    the exact log-density at points x (m, k), r times each: from seeds (m, r, v) to estimates
    (m, r). ``seeds_of_point`` are r, as by `seeds_needed`, and v, the number of noisy likelihoods;
    ``announce`` is told what is evaluated next, and the number of estimates.
    """
    n_seeds, n_noisy = seeds_of_point
    fit = choose_mixture(posterior, rng)
    draws = kept.draws.reshape(-1, kept.draws.shape[-1])
    level = float(np.quantile(fit.log_density(draws), BEYOND))

    def once(x: Array) -> Array:
        return evaluate(x, fresh_seeds((len(x), 1, n_noisy), rng))[:, 0]

    announce("search beyond the draws", N_ROUNDS * N_SEARCHED)
    q = defensive_mixture(posterior, fit, level, once, rng)
    points = q.sample(max(FEWEST_POINTS, int(POINTS_PER_DRAW * len(draws))), rng)
    x = np.concatenate([draws, points])
    seeds = fresh_seeds((len(x), n_seeds, n_noisy), rng)
    announce("weights", n_seeds * len(x))
    log_estimates = evaluate(x, seeds)
    log_target = logsumexp(log_estimates, axis=1) - np.log(n_seeds)
    for part in np.split(log_target, [len(draws)]):
        check_overlap(part)
    approximate = np.append(kept.log_density.ravel(), posterior.evaluate(points, rng))
    pooled = Pooled(
        kept.log_density.shape, log_target, approximate, q.log_density(x), kept.population
    )
    return Correction(x, seeds, log_estimates, pooled, fit.log_density(x))


def exact_posterior(
    posterior: Posterior,
    density: ExactDensity,
    rng: np.random.Generator,
    announce: Callable[[str, int], None],
) -> Posterior:
    """Draws that say where the exact posterior lies, and its density.

    They are those of the approximate posterior, at most `MOST_DRAWS`, corrected; or as they are, if
    too few effective ones would be left.
    """
    n_seeds = seeds_needed(posterior, density.evaluate, density.n_noisy, rng)
    kept = posterior.thinned(min(MOST_DRAWS, max(FEWEST_GUIDING, MOST_GUIDING // n_seeds)))
    seeds_of_point = n_seeds, density.n_noisy
    found = correct(posterior, kept, density.evaluate, seeds_of_point, rng, announce)
    if found.pooled.effective_size(found.x) >= MIN_EFFECTIVE:
        index, chosen = found.resampled(rng)
    else:
        index = np.arange(kept.log_density.size).reshape(kept.log_density.shape)
        chosen = np.zeros_like(index)
    log_density = found.log_estimates[index, chosen]
    # Zeros become the smallest density that is positive: no quadratic is fitted to infinities.
    least = log_density[np.isfinite(log_density)].min()
    return replace(
        kept,
        draws=found.x[index],
        log_density=np.maximum(log_density, least),
        evaluate=density.evaluate_afresh,
        is_noisy=density.n_noisy > 0,
        population=None,  # resampled over all of them
    )


def seeds_needed(
    posterior: Posterior, evaluate: Evaluate, n_noisy: int, rng: np.random.Generator
) -> int:
    """How many estimates of a point are averaged, so that their noise decides no weight.

    If the log of an estimate has the variance v, the mean of r of them has the relative variance
    (exp(v) - 1) / r. That of most draws decides: at few that are far noisier no mean is good.
    """
    if not n_noisy:
        return 1
    draws = posterior.draws.reshape(-1, posterior.draws.shape[-1])
    measured = draws[np.linspace(0, len(draws) - 1, N_MEASURED).astype(int)]
    found = evaluate(measured, fresh_seeds((N_MEASURED, N_MEASURING, n_noisy), rng))
    finite = found[np.isfinite(found).all(axis=1)]
    variance = float(np.median(finite.var(axis=1, ddof=1))) if len(finite) else np.inf
    most = np.log1p(MAX_NOISE * MOST_SEEDS)
    return max(1, int(np.ceil(np.expm1(min(variance, most)) / MAX_NOISE)))


def _weighted_quantile(values: Array, log_weights: Array, probability: float) -> float:
    order = np.argsort(values)
    below = np.cumsum(normalised(log_weights)[order])
    place = int(np.searchsorted(below, probability))
    return float(values[order[min(place, len(values) - 1)]])
