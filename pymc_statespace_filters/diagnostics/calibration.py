"""Whether predictions are calibrated: where data fall among draws of their predictions."""

import numpy as np
from arviz_stats.base import array_stats
from numpy.typing import NDArray
from scipy.stats import chi2, norm

Array = NDArray[np.float64]

MAX_LAGS, OBSERVATIONS_PER_LAG = 10, 5  # of the test of whiteness


def pit_of(observed: Array, predicted: Array, rng: np.random.Generator) -> Array:
    """The share of draws (S, ...) not above the observed (...), between those it lies between.

    The rank of the datum among itself and the draws, ties and the place within a rank at random:
    uniform if the datum is one of them, for counts too (Czado, Gneiting and Held 2009). NaN where
    the datum is missing; draws that are NaN are left out.
    """
    n_draws = np.isfinite(predicted).sum(axis=0)
    below = (predicted < observed).sum(axis=0)
    ties = (predicted == observed).sum(axis=0)
    pit = (below + rng.uniform(size=observed.shape) * (ties + 1)) / (n_draws + 1)
    return np.where(np.isnan(observed) | (n_draws == 0), np.nan, pit)


def residual_of(pit: Array, n_draws: int) -> Array:
    """Standard normal quantiles, no further out than the draws can tell."""
    furthest = 0.5 / n_draws
    return norm.ppf(np.clip(pit, furthest, 1 - furthest))


def coverage_of(pit: Array, prob: float) -> Array:
    """The share of data (J, p) within the central interval of their predictions, (p,)."""
    known = np.isfinite(pit)
    inside = np.abs(pit - 0.5) <= prob / 2
    n_known = known.sum(axis=0)
    return np.where(n_known > 0, inside.sum(axis=0) / np.maximum(n_known, 1), np.nan)


def uniformity_of(pit: Array) -> float:
    """The p-value of a test that the numbers that are not missing are uniform, or NaN.

    Where each order statistic lies in its own law, joined as truncated Cauchy variables: the test
    that ArviZ writes into its pictures of PIT values.
    """
    known = pit[np.isfinite(pit)]
    if known.size < 2:
        return np.nan
    return float(array_stats.uniformity_test(known, method="pot_c")[0])


def whiteness_of(residual: Array) -> float:
    """The p-value of the test of Ljung and Box (1978), or NaN: no autocorrelation at any lag.

    Up to lag 10, or a fifth of the number of residuals; missing ones are left out.
    """
    known = residual[np.isfinite(residual)]
    n = known.size
    lags = np.arange(1, min(MAX_LAGS, n // OBSERVATIONS_PER_LAG) + 1)
    centred = known - known.mean() if n else known
    if not lags.size or not centred.any():
        return np.nan
    correlation = np.array([centred[lag:] @ centred[:-lag] for lag in lags]) / (centred @ centred)
    statistic = n * (n + 2) * np.sum(correlation**2 / (n - lags))
    return float(chi2.sf(statistic, lags.size))
