"""Poisson and binomial laws by their recurrences, in extended precision."""

import numpy as np
from scipy import special

REACH = 12.0  # standard deviations on either side of the mean, and as many numbers


class CountLaw:
    """Both tails of a law of counts, normalised by their own sum: no factorials are needed."""

    def __init__(self, first, terms):
        peak = np.argmax(terms)
        probabilities = terms.astype(np.longdouble) / terms[peak]
        total = probabilities.sum()
        self.first = first
        k = np.arange(len(terms))
        mean = (k * probabilities).sum() / total
        self.sd = float(np.sqrt(((k - mean) ** 2 * probabilities).sum() / total))
        self.lower = np.cumsum(probabilities) / total  # P(N <= k)
        self.upper = (np.cumsum(probabilities[::-1])[::-1] - probabilities) / total  # P(N > k)

    def quantiles(self, z):
        """The least k with P(N <= k) >= Φ(z), and whether rounding of Φ(z) might move it."""
        low = np.searchsorted(self.lower, special.ndtr(z).astype(np.longdouble), side="left")
        high = np.searchsorted(-self.upper, -special.ndtr(-z).astype(np.longdouble), side="left")
        index = np.minimum(np.where(z <= 0.0, low, high), len(self.lower) - 1)
        tails = np.where(z <= 0.0, self.lower[index], self.upper[index])
        before = np.where(z <= 0.0, self.lower[index - 1], self.upper[index - 1])
        sought = special.ndtr(-abs(z))
        close = (abs(tails / sought - 1.0) < 1e-12) | (abs(before / sought - 1.0) < 1e-12)
        return self.first + index.astype(float), close


def poisson(mean):
    """The law of a Poisson number, ten and more standard deviations wide."""
    width = REACH * np.sqrt(mean) + 60.0
    k = np.arange(max(np.floor(mean - width), 0.0), mean + width, dtype=np.longdouble)
    return CountLaw(float(k[0]), from_ratios(np.longdouble(mean) / k[1:]))


def binomial(n, p):
    """The law of the successes in n trials."""
    width = REACH * np.sqrt(n * p * (1.0 - p)) + 60.0
    middle = n * p
    k = np.arange(
        max(np.floor(middle - width), 0.0), min(middle + width, n) + 1.0, dtype=np.longdouble
    )
    odds = np.longdouble(p) / (1.0 - np.longdouble(p))
    return CountLaw(float(k[0]), from_ratios((n - k[:-1]) / k[1:] * odds))


def from_ratios(ratios):
    """Terms that follow each other by these ratios, the largest about 1."""
    logs = np.concatenate([[0.0], np.cumsum(np.log(ratios))])
    peak = int(np.argmax(logs))
    after = np.cumprod(ratios[peak:])
    before = np.cumprod(1.0 / ratios[:peak][::-1])[::-1]
    return np.concatenate([before, [np.longdouble(1.0)], after])
