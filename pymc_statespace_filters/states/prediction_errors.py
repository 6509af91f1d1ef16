"""Errors of predictions at draws of the posterior: their size, and the coverage of intervals."""

import warnings

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pymc_statespace_filters.states.draws import SAMPLE_DIMS

PROBABILITIES = (0.5, 0.9)  # of the central intervals


def prediction_errors(
    predicted: xr.DataArray, measured: NDArray[np.float64], observed: NDArray[np.float64]
) -> xr.Dataset:
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
                f"{name}_coverage": _coverage(
                    predicted.copy(data=measured.reshape(predicted.shape)), record, time
                ),
            }
        )


def _rmse(predicted: xr.DataArray, record: xr.DataArray, time: str) -> xr.DataArray:
    return ((predicted - record) ** 2).mean(time) ** 0.5


def _coverage(measured: xr.DataArray, record: xr.DataArray, time: str) -> xr.DataArray:
    """Fraction of the record in the central intervals of each time."""
    fractions = []
    for probability in PROBABILITIES:
        ends = measured.quantile(
            [(1 - probability) / 2, (1 + probability) / 2], dim=SAMPLE_DIMS, skipna=True
        )
        low, high = ends.isel(quantile=0, drop=True), ends.isel(quantile=1, drop=True)
        known = record.notnull() & low.notnull()
        inside = (record >= low) & (record <= high)
        fractions.append(inside.where(known).mean(time))
    return xr.concat(fractions, xr.Variable("interval", list(PROBABILITIES)))
