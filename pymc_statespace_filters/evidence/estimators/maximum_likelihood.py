"""The largest likelihood, for the information criteria."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import KDTree

from pymc_statespace_filters.evidence.estimators.newton import (
    BatchFunction,
    best_of_chains,
    newton_maximize,
)
from pymc_statespace_filters.evidence.estimators.whitening import moments_within_chains
from pymc_statespace_filters.evidence.log_mean import log_mean_of_independent
from pymc_statespace_filters.evidence.posterior.draws import Posterior, log_likelihood_of

N_STARTS = 3
BEYOND = -1e300
N_SIMPLEX = 200  # evaluations per parameter of a simplex along an edge
# Of noisy likelihoods: fresh estimates that choose among the candidates, and that value the choice.
N_CHOOSING, N_VALUING = 40, 100
N_EVALUATIONS = 6 * N_CHOOSING + N_VALUING
N_NEIGHBOURS, N_THINNED, SHARE_NEAR = 30, 2000, 0.2

Array = NDArray[np.float64]


class MaximumLikelihood(NamedTuple):
    """The largest likelihood that was found, and where.

    Attributes
    ----------
    log_likelihood : float
    point : ndarray (k,)
        Unconstrained.
    """

    log_likelihood: float
    point: Array


def max_log_likelihood(posterior: Posterior, rng: np.random.Generator) -> MaximumLikelihood:
    """Maximise everything in the model but its prior.

    A likelihood that is a function is climbed by Newton's method, from the draws of largest
    likelihood of several chains. Towards a bound of the parameters, which is infinitely far on the
    unconstrained space, it levels off, and the climb ends where it has done so; at the edge of a
    support without a transform a simplex goes on alone. The value is no less than that of any draw.

    A noisy likelihood is maximised without being climbed: of many noisy values the largest would be
    the luckiest. A quadratic is fitted to the estimates that the chains stored, whose noise it
    averages out, all the more as there are more draws; its best places, and the mean of the draws,
    are then compared by fresh estimates, and the winner is valued by others that had no part in
    its choice. So the value is the likelihood at a central point near the maximum, as an unbiased
    average of `N_VALUING` estimates, and falls short of the maximum by what the quadratic misses.

    Parameters
    ----------
    posterior : Posterior
        With its prior.
    rng : numpy.random.Generator
        For the noise of the likelihood.

    Returns
    -------
    MaximumLikelihood
    """
    coordinates = moments_within_chains(posterior.draws)

    def log_likelihood(z: Array) -> Array:
        return posterior.evaluate_factors(coordinates.unconstrained(z), rng)[1]

    draws = posterior.draws.reshape(-1, posterior.draws.shape[-1])
    log_prior = posterior.required_prior.log_density(draws).reshape(posterior.log_density.shape)
    at_draws = log_likelihood_of(posterior.log_density, log_prior)
    find = _estimated if posterior.is_noisy else _climbed
    value, z = find(log_likelihood, coordinates.whitened(draws), at_draws)
    return MaximumLikelihood(value, coordinates.unconstrained(z[np.newaxis])[0])


def _climbed(log_likelihood: BatchFunction, draws: Array, at_draws: Array) -> tuple[float, Array]:
    """The top of a likelihood that is a function, in whitened coordinates."""
    best = best_of_chains(at_draws, N_STARTS)
    top = max((newton_maximize(log_likelihood, draws[i]) for i in best), key=lambda top: top.value)
    found = [(top.value, top.point), (float(at_draws.ravel()[best[0]]), draws[best[0]])]
    if top.at_edge:
        found.append(_along_edge(log_likelihood, top.point))
    return max(found, key=lambda candidate: candidate[0])


def _along_edge(log_likelihood: BatchFunction, start: Array) -> tuple[float, Array]:
    """Nelder and Mead's simplex, which needs no derivatives; beyond the edge it is merely low."""
    k = len(start)
    ended = minimize(
        lambda z: -max(float(log_likelihood(z[np.newaxis])[0]), BEYOND),
        start,
        method="Nelder-Mead",
        options={
            "initial_simplex": start + 0.1 * np.vstack([np.zeros(k), np.eye(k)]),
            "maxfev": N_SIMPLEX * k,
            "adaptive": True,
        },
    )
    return -float(ended.fun), ended.x


def _estimated(log_likelihood: BatchFunction, draws: Array, at_draws: Array) -> tuple[float, Array]:
    """A high place of a noisy likelihood, and the log of an average of fresh estimates there."""
    candidates = _candidates(draws, at_draws.ravel())
    repeated = log_likelihood(np.repeat(candidates, N_CHOOSING, axis=0))
    heights = [
        log_mean_of_independent(values).value for values in repeated.reshape(len(candidates), -1)
    ]
    chosen = candidates[int(np.argmax(heights))]
    valued = log_likelihood(np.repeat(chosen[np.newaxis], N_VALUING, axis=0))
    return log_mean_of_independent(valued).value, chosen


def _candidates(draws: Array, values: Array) -> Array:
    """Places where noisy values may be largest, (6, k).

    The mean of the draws; the best draw and the summit of a quadratic fitted to all of them; the
    draw whose neighbours have the largest values on average, and the same two for a quadratic that
    is fitted about it.
    """
    thinned = np.linspace(0, len(draws) - 1, min(len(draws), N_THINNED)).astype(int)
    _, neighbours = KDTree(draws[thinned]).query(draws[thinned], min(N_NEIGHBOURS, len(thinned)))
    dense = draws[thinned[values[thinned][neighbours].mean(axis=1).argmax()]]
    distance = np.linalg.norm(draws - dense, axis=1)
    near = distance <= np.quantile(distance, SHARE_NEAR)
    fitted = (*_quadratic_tops(draws, values), *_quadratic_tops(draws[near], values[near]))
    return np.stack([np.zeros_like(dense), dense, *fitted])


def _quadratic_tops(draws: Array, values: Array) -> tuple[Array, Array]:
    """The best draw under a fitted quadratic and, if it has one, its summit."""
    m, k = draws.shape
    i, j = np.triu_indices(k)
    features = np.column_stack([np.ones(m), draws, draws[:, i] * draws[:, j]])
    # By the normal equations: in whitened coordinates these features are nearly orthogonal.
    coefficients = np.linalg.lstsq(features.T @ features, features.T @ values)[0]
    slope, form = coefficients[1 : k + 1], np.zeros((k, k))
    form[i, j] = coefficients[k + 1 :]
    hessian = form + form.T
    best = draws[(features @ coefficients).argmax()]
    if np.linalg.eigvalsh(hessian)[-1] >= 0:
        return best, best
    summit = -np.linalg.solve(hessian, slope)
    # Not beyond the draws, where the quadratic is a guess.
    furthest = np.linalg.norm(draws, axis=1).max()
    return best, summit * min(1.0, furthest / np.linalg.norm(summit))
