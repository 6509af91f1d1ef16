"""Maximum likelihood, for the information criteria AIC and BIC."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import KDTree

from ...statistics.importance import log_mean_of_independent
from ..posterior import Posterior, log_likelihood_of
from .newton import BatchFunction, best_of_chains, newton_maximize
from .whitening import moments_within_chains

N_STARTS = 3
BEYOND = -1e300  # finite stand-in for -inf, which the simplex cannot use
N_SIMPLEX = 200  # evaluations per parameter of a simplex search along an edge
# For noisy likelihoods: fresh estimates per candidate to select the best, and to evaluate it.
N_CHOOSING, N_VALUING = 40, 100
N_EVALUATIONS = 6 * N_CHOOSING + N_VALUING
N_NEIGHBOURS, N_THINNED, FRACTION_NEAR = 30, 2000, 0.2

Array = NDArray[np.float64]


class MaximumLikelihood(NamedTuple):
    """The largest log-likelihood found, and its point."""

    log_likelihood: float
    point: Array  # (k,), unconstrained


def max_log_likelihood(posterior: Posterior, rng: np.random.Generator) -> MaximumLikelihood:
    """Maximise the likelihood: everything in the model except the prior.

    A deterministic likelihood is maximised by Newton's method, from the draws of largest likelihood
    of several chains. Towards a bound of the parameters, infinitely far on the unconstrained space,
    it levels off and the search stops; at the edge of a support without a transform a simplex
    search continues. The value is at least that of every draw.

    A noisy likelihood is not maximised directly, because the largest of many noisy values is biased
    upwards. A quadratic is fitted to the estimates stored by the chains, which averages out their
    noise. Its best points and the mean of the draws are compared by fresh estimates, and the best
    is evaluated by further ones, independent of the selection. The value is therefore the
    likelihood at a point near the maximum, an unbiased average of `N_VALUING` estimates; it lies
    below the maximum by the misfit of the quadratic.
    """
    coordinates = moments_within_chains(posterior.draws)

    def log_likelihood(z: Array) -> Array:
        return posterior.evaluate_factors(coordinates.unconstrained(z), rng)[1]

    draws = posterior.draws.reshape(-1, posterior.draws.shape[-1])
    log_prior = posterior.required_prior.log_density(draws).reshape(posterior.log_density.shape)
    at_draws = log_likelihood_of(posterior.log_density, log_prior)
    maximize = maximize_noisy if posterior.is_noisy else _maximize_deterministic
    value, z = maximize(log_likelihood, coordinates.whitened(draws), at_draws)
    return MaximumLikelihood(value, coordinates.unconstrained(z[np.newaxis])[0])


def _maximize_deterministic(
    log_likelihood: BatchFunction, draws: Array, at_draws: Array
) -> tuple[float, Array]:
    """Maximum of a deterministic likelihood, in whitened coordinates."""
    best = best_of_chains(at_draws, N_STARTS)
    maxima = [newton_maximize(log_likelihood, draws[i]) for i in best]
    largest = max(maxima, key=lambda maximum: maximum.value)
    found = [(largest.value, largest.point), (float(at_draws.ravel()[best[0]]), draws[best[0]])]
    if largest.at_edge:
        found.append(maximize_along_edge(log_likelihood, largest.point))
    return max(found, key=lambda candidate: candidate[0])


def maximize_along_edge(log_likelihood: BatchFunction, start: Array) -> tuple[float, Array]:
    """Nelder and Mead's simplex search, which needs no derivatives."""
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


def maximize_noisy(
    log_likelihood: BatchFunction, draws: Array, at_draws: Array
) -> tuple[float, Array]:
    """A point near the maximum of a noisy likelihood, with the log mean of fresh estimates."""
    candidates = _candidates(draws, at_draws.ravel())
    repeated = log_likelihood(np.repeat(candidates, N_CHOOSING, axis=0))
    means = [
        log_mean_of_independent(values).value for values in repeated.reshape(len(candidates), -1)
    ]
    best = candidates[int(np.argmax(means))]
    fresh = log_likelihood(np.repeat(best[np.newaxis], N_VALUING, axis=0))
    return log_mean_of_independent(fresh).value, best


def _candidates(draws: Array, values: Array) -> Array:
    """Points at which the mean of noisy values may be largest, (6, k).

    The mean of the draws; the draw whose neighbours have the largest mean value; and the best draw
    and the maximum of two quadratics, fitted to all draws and to those near that draw.
    """
    thinned = np.linspace(0, len(draws) - 1, min(len(draws), N_THINNED)).astype(int)
    _, neighbours = KDTree(draws[thinned]).query(draws[thinned], min(N_NEIGHBOURS, len(thinned)))
    dense = draws[thinned[values[thinned][neighbours].mean(axis=1).argmax()]]
    distance = np.linalg.norm(draws - dense, axis=1)
    near = distance <= np.quantile(distance, FRACTION_NEAR)
    fitted = (*_quadratic_maxima(draws, values), *_quadratic_maxima(draws[near], values[near]))
    return np.stack([np.zeros_like(dense), dense, *fitted])


def _quadratic_maxima(draws: Array, values: Array) -> tuple[Array, Array]:
    """The best draw under a fitted quadratic, and its maximum if it has one."""
    m, k = draws.shape
    i, j = np.triu_indices(k)
    features = np.column_stack([np.ones(m), draws, draws[:, i] * draws[:, j]])
    # The normal equations are well conditioned: whitened features are nearly orthogonal.
    coefficients = np.linalg.lstsq(features.T @ features, features.T @ values)[0]
    slope, form = coefficients[1 : k + 1], np.zeros((k, k))
    form[i, j] = coefficients[k + 1 :]
    hessian = form + form.T
    best = draws[(features @ coefficients).argmax()]
    if np.linalg.eigvalsh(hessian)[-1] >= 0:
        return best, best
    maximum = -np.linalg.solve(hessian, slope)
    # Do not extrapolate the quadratic beyond the draws.
    furthest = np.linalg.norm(draws, axis=1).max()
    return best, maximum * min(1.0, furthest / np.linalg.norm(maximum))
