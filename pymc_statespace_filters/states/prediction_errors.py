"""Errors of predictions at draws of the posterior: their size, and the coverage of intervals."""

import warnings

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from .draws import SAMPLE_DIMS

PROBABILITIES = np.array([0.5, 0.9])  # of the central intervals

Array = NDArray[np.float64]


def prediction_errors(predicted: xr.DataArray, measured: Array, observed: Array) -> xr.Dataset:
    """Errors of predictions (chain, draw, time, observable) of a record (R, p).

    ``measured`` (draws, R, p) are predictions with measurement noise. Missing data and NaN draws
    are left out.
    """
    name, (time, observable) = predicted.name, map(str, predicted.dims[-2:])
    record = xr.DataArray(observed, dims=(time, observable))
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)  # means of nothing are NaN
        rmse = _rmse(predicted.mean(SAMPLE_DIMS), record, time)
        return xr.Dataset(
            {
                f"{name}_rmse": rmse,
                f"{name}_relative_error": rmse / record.std(time),
                f"{name}_rmse_of_draws": _rmse(predicted, record, time),
                f"{name}_coverage": (("interval", observable), _coverage(measured, observed)),
            },
            coords={"interval": PROBABILITIES.tolist()},
        )


def _rmse(predicted: xr.DataArray, record: xr.DataArray, time: str) -> xr.DataArray:
    return ((predicted - record) ** 2).mean(time) ** 0.5


def _coverage(measured: Array, observed: Array) -> Array:
    """Fraction (2, p) of the record in the central intervals of each time."""
    known, drawn = ~np.isnan(observed), measured[np.isfinite(measured).all(axis=(1, 2))]
    if not len(drawn):
        return np.full((len(PROBABILITIES), observed.shape[1]), np.nan)
    low, high = (np.quantile(drawn, (1 + sign * PROBABILITIES) / 2, axis=0) for sign in (-1, 1))
    inside = known & (low <= observed) & (observed <= high)
    return inside.sum(axis=1) / known.sum(axis=0)
