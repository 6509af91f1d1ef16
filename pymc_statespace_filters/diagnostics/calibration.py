"""Calibration of predictions: PIT values, residuals, coverage, tests of both, and correlations."""

from typing import Any

import numpy as np
from arviz_stats.base import array_stats
from numpy.typing import NDArray
from scipy.stats import chi2, norm

Array = NDArray[np.float64]

MAX_LAGS, OBSERVATIONS_PER_LAG = 10, 5  # of the whiteness test
MAX_LAG, PER_LAG = 25, 4  # of the correlations that are returned


def residual_limit(n_draws: Any) -> Any:
    """The largest residual that so many draws of a prediction can tell."""
    return norm.isf(0.5 / n_draws)


def coverage_of(pit: Array, prob: float) -> Array:
    """Fraction of observations (J, p) within the central prediction interval, (p,)."""
    known = np.isfinite(pit)
    inside = np.abs(pit - 0.5) <= prob / 2
    n_known = known.sum(axis=0)
    return np.where(n_known > 0, inside.sum(axis=0) / np.maximum(n_known, 1), np.nan)


def uniformity_of(pit: Array) -> float:
    """The p-value of a test that the values that are not missing are uniform, or NaN.

    The test of ArviZ's PIT plots: p-values of the order statistics, combined by the truncated
    Cauchy method.
    """
    known = pit[np.isfinite(pit)]
    if known.size < 2:
        return np.nan
    return float(array_stats.uniformity_test(known, method="pot_c")[0])


def whiteness_of(residual: Array) -> float:
    """The p-value of the test of Ljung and Box (1978) for autocorrelation, or NaN.

    Up to lag 10, or a fifth of the number of residuals; missing residuals are dropped.
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


def lags_of(n_observations: int) -> NDArray[np.int64]:
    """Lags from 1 on, in observations: up to 25, or a quarter of the observations."""
    return np.arange(1, max(1, min(MAX_LAG, n_observations // PER_LAG)) + 1)


def standardised(innovation: Array, cov: Array) -> Array:
    """Innovations (J, p) divided by their standard deviations; NaN where these are zero."""
    sd = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    return np.divide(innovation, sd, out=np.full_like(sd, np.nan), where=sd > 0.0)


def autocorrelation_of(z: Array, lags: NDArray[np.int64]) -> Array:
    """Correlation (lags, p) of each column with itself so many rows earlier; NaN rows drop out."""
    return np.array([[_correlation(c[lag:], c[:-lag]) for c in z.T] for lag in lags])


def input_correlation_of(z: Array, inputs: Array, lags: NDArray[np.int64]) -> Array:
    """Correlation (lags, inputs, p) of each column with inputs (J, n_inputs) so many rows earlier.

    Lag 0 is the input of the same row.
    """
    n = len(z)
    return np.array(
        [[[_correlation(c[lag:], u[: n - lag]) for c in z.T] for u in inputs.T] for lag in lags]
    ).reshape(len(lags), inputs.shape[1], z.shape[1])


def inputs_before(inputs: Array, steps: NDArray[np.int64]) -> Array:
    """The input (J, n_inputs) during the last step before each observation; NaN before step 0."""
    rows = np.minimum(np.maximum(steps - 1, 0), max(len(inputs) - 1, 0))
    return np.where((steps > 0)[:, None], inputs[rows], np.nan)


def _correlation(a: Array, b: Array) -> float:
    """Correlation over the pairs without NaN; NaN where either does not vary."""
    known = np.isfinite(a) & np.isfinite(b)
    if known.sum() < 3:
        return np.nan
    a, b = a[known] - a[known].mean(), b[known] - b[known].mean()
    norm = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / norm) if norm > 0.0 else np.nan
