"""Means of positive terms given by their logarithms, with standard errors."""

import math
from typing import NamedTuple

import numpy as np
from arviz_stats import mcse
from arviz_stats.base import array_stats
from numpy.typing import NDArray

MIN_EFFECTIVE = 100  # effective terms below which a standard error is unreliable
SAME = 1e-9  # nats, between weights that count as equal
NEGLIGIBLE = 700.0  # nats below the largest weight

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


def log_mean(log_terms: Array) -> float:
    """Log of the mean of all terms, those of -inf included as zeros."""
    peak = log_terms.max()
    return float(peak + np.log(np.exp(log_terms - peak).mean())) if peak > -np.inf else -np.inf


def mcse_of_chains(terms: Array) -> float:
    """Standard error of the mean of autocorrelated terms, shape (chain, draw).

    ArviZ's, from Geyer's initial monotone sequence over split chains: it includes the disagreement
    between chains as well as the autocorrelation within them.
    """
    return float(mcse(terms, method="mean"))


def mcse_of_walkers(terms: Array) -> float:
    """Standard error of the mean over many independent short chains, shape (chain, draw).

    From the spread of the chains' means, whatever the autocorrelation within them.
    """
    return float(terms.mean(axis=1).std(ddof=1) / len(terms) ** 0.5)


def log_mean_of_chains(log_terms: Array) -> LogMean:
    """Average autocorrelated terms, shape (chain, draw)."""
    value = log_mean(log_terms)
    return LogMean(value, mcse_of_chains(np.exp(log_terms - value)))


def log_mean_of_independent(log_terms: Array) -> LogMean:
    """Average independent terms, shape (m,), those of -inf included as zeros."""
    value = log_mean(log_terms)
    if np.isneginf(value):
        return LogMean(-np.inf, np.inf)
    return LogMean(value, float(np.exp(log_terms - value).std() / len(log_terms) ** 0.5))


def pareto_k(log_weights: Array) -> float:
    """Pareto shape of the upper tail of weights, larger if heavier; -inf if all are equal."""
    # ArviZ does not accept infinities.
    weights = np.maximum(log_weights.ravel(), log_weights.max() - NEGLIGIBLE)
    n_tail = math.ceil(min(0.2 * weights.size, 3 * weights.size**0.5))
    if np.ptp(np.sort(weights)[-n_tail:]) < SAME:
        return -np.inf
    return float(array_stats.psislw(-weights)[1])  # expects log-likelihoods, not log weights
