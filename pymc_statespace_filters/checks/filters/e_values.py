"""Tests of an upper bound for a likelihood by unbiased estimates, at any tails.

If a likelihood L is at most e^c, then X = estimate / e^c has mean at most 1, and so has the product
of independent factors 1 - s + s X for any share s from 0 to 1: what a gambler has who bets the
share s of his money on each X. The mean of such products over several shares, an e-value, exceeds
1 / alpha with probability alpha at most (Markov). It needs no law of the estimates, whose tails are
unknown where particles are few. Large shares see a small difference in quiet estimates, small
shares a large one in noisy estimates, where one estimate in many is right.

References
----------
A. Ramdas, P. Gruenwald, V. Vovk and G. Shafer (2023). Game-theoretic statistics and safe anytime-
valid inference. Statistical Science 38, 576-601.
I. Waudby-Smith and A. Ramdas (2024). Estimating means of bounded random variables by betting.
Journal of the Royal Statistical Society B 86, 1-27.
"""

import numpy as np
from numpy.typing import NDArray

from ...statistics.importance import log_sum

Array = NDArray[np.float64]

_SHARES = 2.0 ** -np.arange(6.0)
# A bound lies at most so far, in nats, below the highest estimate above it.
_FARTHEST = 1e3
_N_HALVINGS = 18  # to a hundredth of a nat


def log_e_values(log_ratios: Array) -> Array:
    """The log of the e-value (m,) of each row of estimates over bounds, log X (m, r)."""
    shares = _SHARES[:, None, None]
    with np.errstate(divide="ignore"):
        kept = np.log1p(-shares)
    money = np.logaddexp(kept, np.log(shares) + log_ratios).sum(axis=-1)
    return log_sum(money, axis=0) - np.log(len(_SHARES))


def proved_shortfall(estimates: Array, bounds: Array, alpha: float) -> float:
    """The largest t for which the bounds plus t are rejected together, at level alpha.

    With probability 1 - alpha at least, some log-likelihood exceeds its bound by more than t. The
    e-values of all points are averaged. Minus infinity if no estimate is finite.

    Parameters
    ----------
    estimates : ndarray, shape (m, r)
        Logs of independent unbiased estimates at m points; minus infinity for a failure.
    bounds : ndarray, shape (m,)
        Finite numbers, independent of the estimates' noise.
    alpha : float
    """
    ratios = estimates - bounds[:, None]
    high = float(ratios.max(initial=-np.inf))
    if high == -np.inf:
        return high
    needed, low = np.log(len(bounds) / alpha), high - _FARTHEST
    for _ in range(_N_HALVINGS):  # the e-value falls with t, and is 1 at most at the highest ratio
        middle = 0.5 * (low + high)
        if log_sum(log_e_values(ratios - middle)) >= needed:
            low = middle
        else:
            high = middle
    return low


def visible_shortfall(estimates: Array, bounds: Array, alpha: float) -> float:
    """How far below the likelihood the bounds would have to be for these estimates to prove it.

    Typical of the points: with estimates of the same scatter around a likelihood that is so far
    above the bounds. Infinite where the estimates lie below the bounds by their own collapse.
    """
    centre = log_sum(estimates, axis=1) - np.log(estimates.shape[1])
    if not np.isfinite(centre).any():
        return np.inf
    seen = np.isfinite(centre)
    gap = np.median(np.maximum(bounds - centre, 0.0)[seen])
    return float(gap - proved_shortfall(estimates[seen], centre[seen], alpha))
