"""Innovations: what an observation differs from its prediction by, and what it correlates with."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_LAG, OBSERVATIONS_PER_LAG = 25, 4


def lags_of(n_observations: int) -> NDArray[np.int64]:
    """Lags from 1 on, in observations: up to 25, or a quarter of the observations."""
    return np.arange(1, max(1, min(MAX_LAG, n_observations // OBSERVATIONS_PER_LAG)) + 1)


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
