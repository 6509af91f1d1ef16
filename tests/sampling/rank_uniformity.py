"""Are ranks uniform? A chi-square test, and the simultaneous band of their ECDF.

Ranks are integers from 0 to ``n_ranks - 1``.

References
----------
T. Säilynoja, P.-C. Bürkner and A. Vehtari (2022). Graphical test for discrete uniformity and its
applications in goodness-of-fit evaluation and multiple sample comparison. Statistics and Computing
32, 32.
"""

from functools import cache

import numpy as np
from scipy.optimize import brentq
from scipy.stats import binom, chisquare, poisson


def chi_square_p(ranks, n_ranks, n_bins):
    """Probability of counts in bins of equal width as uneven as these."""
    return chisquare(histogram(ranks, n_ranks, n_bins)).pvalue


def histogram(ranks, n_ranks, n_bins):
    if n_ranks % n_bins:
        raise ValueError(f"{n_bins} bins of one width cannot hold {n_ranks} ranks")
    return np.bincount(np.asarray(ranks) * n_bins // n_ranks, minlength=n_bins)


def ecdf_counts(ranks, n_ranks):
    """How many ranks lie below 1, 2, ... ``n_ranks - 1``."""
    return np.cumsum(np.bincount(ranks, minlength=n_ranks))[:-1]


def ecdf_p(ranks, n_ranks):
    """Probability that the ECDF of uniform ranks is anywhere as far out as this one.

    Far out is a small tail probability of the binomial law that the count has at that place, so
    that the ends weigh as much as the middle.
    """
    n = len(ranks)
    furthest = _tails(n, n_ranks)[np.arange(n_ranks - 1), ecdf_counts(ranks, n_ranks)].min()
    return 1.0 - _coverage(n, n_ranks, furthest * (1.0 + 1e-9))


def ecdf_band(n, n_ranks, error_rate):
    """Counts, lowest and highest, between which all of a uniform ECDF lies but at this rate."""
    log_tail = brentq(
        lambda t: 1.0 - _coverage(n, n_ranks, np.exp(t)) - error_rate, np.log(1e-15), 0.0, xtol=1e-6
    )
    inside = _tails(n, n_ranks) >= np.exp(log_tail)
    return inside.argmax(axis=1), n - inside[:, ::-1].argmax(axis=1)


@cache
def _tails(n, n_ranks):
    """The smaller tail probability of each count, (places, n + 1)."""
    places = np.arange(1, n_ranks)[:, None] / n_ranks
    counts = np.arange(n + 1)
    return np.minimum(binom.cdf(counts, n, places), binom.sf(counts - 1, n, places))


def _coverage(n, n_ranks, least_tail):
    """Probability that no count has a tail probability below the given one.

    Numbers of ranks are Poisson variates whose sum is n: the sums are followed from place to place,
    and those outside are left out.
    """
    step = poisson.pmf(np.arange(n + 1), n / n_ranks)
    inside = _tails(n, n_ranks) >= least_tail
    law = np.zeros(n + 1)
    law[0] = 1.0
    for allowed in inside:
        law = np.convolve(law, step)[: n + 1] * allowed
    return np.convolve(law, step)[n] / poisson.pmf(n, n)
