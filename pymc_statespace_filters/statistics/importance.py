"""Importance sampling: means of weights given by their logarithms, and what the weights are worth.

A mean of weights has a standard error; the tail of the weights says whether that error holds, and
their effective number how many equal weights they are worth. Weighted points become draws by
resampling.

ArviZ's statistics are imported where they are used: with SciPy's, which they load, they take a
third of the time to import a sampler.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import chdtri, log_expit, stdtrit

MIN_EFFECTIVE = 100  # effective terms below which a standard error is unreliable
MAX_PARETO_K = 0.7  # above which it is, however many terms there are
SAME = 1e-9  # nats, between weights that count as equal
NEGLIGIBLE = 700.0  # nats below the largest weight
MAX_RHAT = 1.03  # of the terms of a mean; 150 effective terms of four chains reach it by chance
AGREE = 0.99  # probability that chains of one law count as agreeing about a mean

Array = NDArray[np.float64]


class LogMean(NamedTuple):
    """Log of a mean of positive terms, and the relative standard error of that mean."""

    value: float
    error: float

    @property
    def n_effective(self) -> float:
        """Inverse squared relative error: the number of terms of relative variance one."""
        return self.error**-2

    def kish_ess(self, count: int) -> float:
        """Kish's effective sample size of `count` independent terms."""
        return count / (1 + count * self.error**2)


def log_sum(log_terms: Array, axis: int | None = None) -> Array:
    """Log of the sum of terms along an axis, or of all; those of -inf are zeros.

    SciPy's logsumexp would import JAX, where it is installed, at every end of chains.
    """
    peak = np.max(log_terms, axis=axis, keepdims=True)
    shift = np.where(np.isneginf(peak), 0.0, peak)
    with np.errstate(divide="ignore"):
        sums = shift + np.log(np.exp(log_terms - shift).sum(axis=axis, keepdims=True))
    return np.asarray(sums.squeeze(axis))


def log_mean(log_terms: Array) -> float:
    """Log of the mean of all terms, those of -inf included as zeros."""
    return float(log_sum(log_terms)) - math.log(log_terms.size)


def mcse(terms: Array, population: NDArray[np.int64] | None = None) -> float:
    """Standard error of the mean of terms (chain, draw), one of each draw of a posterior.

    ``population`` (chain, draw) has that of each draw, if they are particles: the draws of one have
    common ancestors, so that only populations are independent.
    """
    if population is None:
        return mcse_of_chains(terms)
    return mcse_of_populations(terms, population)


def mcse_of_chains(terms: Array) -> float:
    """Standard error of the mean of autocorrelated terms, shape (chain, draw).

    ArviZ's, from Geyer's initial monotone sequence over split chains. If the means of the chains
    scatter more than the autocorrelation within them allows, it is that of their jackknife, which
    for a mean is their standard deviation over the root of their number, by as much wider as
    Student's interval of so few chains is wider than the normal one.
    """
    import arviz_stats

    pooled, n_chains = float(arviz_stats.mcse(terms, method="mean")), len(terms)
    if n_chains < 2:
        return pooled
    between = float(terms.mean(axis=1).std(ddof=1)) / math.sqrt(n_chains)
    within = (
        math.hypot(*(float(arviz_stats.mcse(one[None], method="mean")) for one in terms)) / n_chains
    )
    if (n_chains - 1) * between**2 <= chdtri(n_chains - 1, 1 - AGREE) * within**2:
        return pooled
    return max(pooled, between * student_factor(n_chains))


def mcse_of_populations(terms: Array, population: NDArray[np.int64]) -> float:
    """Standard error of the mean of terms, each of an independent population, of any shapes.

    From the spread of the means of the populations, which have as many draws as their evidence
    says, with the factor of Student's interval of their number; infinite if there is only one.
    """
    _, index, sizes = np.unique(population.ravel(), return_inverse=True, return_counts=True)
    if (count := len(sizes)) < 2:
        return math.inf
    shares = sizes / index.size
    means = np.bincount(index, terms.ravel()) / sizes
    spread = float((shares**2) @ (means - terms.mean()) ** 2)
    return math.sqrt(spread * count / (count - 1)) * student_factor(count)


def student_factor(count: int) -> float:
    """How much wider than the normal one the 95 % interval from the spread of a few numbers is."""
    return float(stdtrit(count - 1, 0.975)) / 1.96


def disagreement(log_terms: Array) -> str:
    """Whether chains disagree about the terms (chain, draw) of a mean; empty if they do not.

    R-hat is that of the ranks (Vehtari, Gelman, Simpson, Carpenter and Buerkner 2021), thus of the
    terms as of their logarithms.
    """
    from arviz_stats.base import array_stats

    with np.errstate(invalid="ignore"):  # of equal terms it is 0 / 0
        found = float(array_stats.rhat(log_terms, chain_axis=0, draw_axis=1, method="rank"))
    if not found > MAX_RHAT:
        return ""
    return (
        f"the chains disagree about the averaged terms (R-hat {found:.3f}, above {MAX_RHAT}): "
        "draw more"
    )


def mcse_of_walkers(terms: Array) -> float:
    """Standard error of the mean over many independent short chains, shape (chain, draw).

    From the spread of the chains' means, whatever the autocorrelation within them.
    """
    return float(terms.mean(axis=1).std(ddof=1) / len(terms) ** 0.5)


def log_mean_of_draws(log_terms: Array, population: NDArray[np.int64] | None = None) -> LogMean:
    """Average terms (chain, draw), one of each draw of a posterior, with the error of `mcse`."""
    value = log_mean(log_terms)
    return LogMean(value, mcse(np.exp(log_terms - value), population))


def log_mean_of_independent(log_terms: Array) -> LogMean:
    """Average independent terms, shape (m,), those of -inf included as zeros."""
    value = log_mean(log_terms)
    if np.isneginf(value):
        return LogMean(-np.inf, np.inf)
    return LogMean(value, float(np.exp(log_terms - value).std() / len(log_terms) ** 0.5))


def log_mean_of_truncated(log_terms: Array) -> LogMean:
    """The mean of terms of which none exceeds the mean times the root of their number.

    It errs to the lower side (Ionides 2008).
    """
    mean = log_mean_of_independent(log_terms)
    if not np.isfinite(mean.value):
        return mean
    most = mean.value + 0.5 * math.log(len(log_terms))
    return log_mean_of_independent(np.minimum(log_terms, most))


def smoothed(log_weights: Array, r_eff: float = 1.0) -> tuple[Array, float]:
    """Pareto-smoothed log weights, of any shape, and the Pareto shape k of their upper tail.

    k is larger if the tail is heavier. If all weights of the tail are equal, nothing is smoothed
    and k is -inf. ``r_eff`` is the effective over the actual number of draws. Source: Vehtari,
    Simpson, Gelman, Yao and Gabry 2024, J. Mach. Learn. Res. 25(72), 1-58.
    """
    from arviz_stats.base import array_stats

    # ArviZ does not accept infinities.
    finite = np.maximum(log_weights, log_weights.max() - NEGLIGIBLE)
    n_tail = math.ceil(min(0.2 * finite.size, 3 * finite.size**0.5))
    if np.ptp(np.sort(finite, axis=None)[-n_tail:]) < SAME:
        return log_weights, -np.inf
    # It expects log-likelihoods, not log weights, and returns the weights normalised.
    new, tail = array_stats.psislw(-finite.ravel(), r_eff=r_eff)
    return np.where(np.isneginf(log_weights), -np.inf, new.reshape(finite.shape)), float(tail)


def pareto_k(log_weights: Array) -> float:
    """Pareto shape of the upper tail of weights, larger if heavier; -inf if all are equal."""
    return smoothed(log_weights)[1]


def largest_good_k(count: int) -> float:
    """The Pareto shape up to which the mean of so many weights is reliable (the same source)."""
    return min(MAX_PARETO_K, 1 - 1 / math.log10(count))


def normalised(log_weights: Array) -> Array:
    """Weights of sum one, of which at least one is positive."""
    weights = np.exp(log_weights - log_weights.max())
    return np.asarray(weights / weights.sum())


def systematic(weights: Array, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices (count,) of points (n,) in their order, each as often as its weight says, or nearly.

    The number of copies differs from its expectation by less than one.
    """
    ends = np.cumsum(weights)
    places = (rng.random() + np.arange(count)) * (ends[-1] / count)
    return np.minimum(np.searchsorted(ends, places, side="right"), len(weights) - 1)


def bridge_constant(at_draws: Array, at_proposals: Array, log_odds: float) -> float:
    """The log-evidence Z_a by bridge sampling (Meng and Wong 1996).

    ``at_draws`` and ``at_proposals`` are log-ratios l = ln a - ln q at draws and at proposals of q.
    The unique solution of ``ln E_q[s(u)] - ln E_draws[s(-u)] = log_odds``, where s is the logistic
    function and ``u = l - ln Z_a + log_odds``. ``log_odds`` is that of the numbers of draws and
    proposals; -inf may be among the ratios at the proposals.
    """

    def excess(log_evidence: float) -> float:
        shift = log_odds - log_evidence
        upper = log_mean(log_expit(at_proposals + shift))
        return upper - log_mean(log_expit(-at_draws - shift)) - log_odds

    # The evidence lies within the ratios, lowered at most by the fraction of possible proposals.
    possible = at_proposals[~np.isneginf(at_proposals)]
    log_fraction = math.log(possible.size / at_proposals.size) + float(log_expit(log_odds))
    least = min(at_draws.min(), possible.min()) + log_fraction - 1
    most = max(at_draws.max(), possible.max()) + 1
    return float(brentq(excess, least, most, xtol=1e-9))
