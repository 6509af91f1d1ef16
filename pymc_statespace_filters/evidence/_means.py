"""Means of positive terms that are known by their logarithms, with their errors."""

from typing import NamedTuple

import arviz as az
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class LogMean(NamedTuple):
    """Log of a mean of positive terms, and the relative standard error of that mean."""

    value: float
    error: float

    @property
    def n_effective(self) -> float:
        """Inverse squared relative error: as good as so many terms of relative variance one."""
        return self.error**-2


def log_mean_of_chains(log_terms: Array) -> LogMean:
    """Average autocorrelated terms, shape (chain, draw).

    The error is ArviZ's, from Geyer's initial monotone sequence over split chains: it counts the
    disagreement between chains as well as the autocorrelation within them.
    """
    peak = log_terms.max()
    terms = np.exp(log_terms - peak)
    mean = terms.mean()
    return LogMean(float(peak + np.log(mean)), float(az.mcse(terms, method="mean") / mean))


def log_mean_of_independent(log_terms: Array) -> LogMean:
    """Average independent terms, shape (m,); terms of -inf are zeros, and they count."""
    peak = log_terms.max()
    if np.isneginf(peak):
        return LogMean(-np.inf, np.inf)
    terms = np.exp(log_terms - peak)
    mean = terms.mean()
    return LogMean(float(peak + np.log(mean)), float(terms.std() / mean / len(terms) ** 0.5))
