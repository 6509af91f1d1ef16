"""Percentiles of the data in bins of time, pooled over records, beside those of replicates."""

import warnings
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from arviz_plots import PlotCollection

from ..errors import INSIDE, ModelError, ModelWarning
from ..system.checks import check_count, is_integer, shortened
from .over_time import DATA, DRAWS, OPACITIES, over_draws, picture_over_time, points_of
from .picture import Mark
from .results import Rows, group_of, names_of, rows_of
from .shapes import band, bars, curve, interval

PERCENTILES = (5, 50, 95)
GROUPS = ("posterior_predictive", "prior_predictive")
KEYS = {5: "5 %, 95 %", 50: "50 %", 95: ""}


def pooled(
    idata: xr.DataTree, group: str, name: str, rows: Rows, records: Any, model: pm.Model | None
) -> tuple[xr.DataArray, xr.DataArray]:
    """Return the replicates and the data of rows that have data, over "time" and "observable"."""
    if group not in GROUPS:
        raise ModelError(f"group must be one of {list(GROUPS)} with bins, got {group!r}")
    if group == "posterior_predictive" and rows.records is not None:
        _warn_of_same_records(idata, name, rows, model)
    _, data = group_of(idata, "observed_data")
    own = rows_of(idata, data, name, name) if name in data else Rows(rows.times[:0])
    if not np.array_equal(own.times.values, rows.times.values):
        raise ModelError(
            f"idata must have data at the {rows.times.size} rows of {name!r} in {group} with bins, "
            f"got {own.times.size} rows, or other times"
        )
    replicates, observed = (
        Rows(one.times).over_time(found[name]).rename({found[name].dims[-1]: "observable"})
        for one, found in ((rows, idata[group].to_dataset()), (own, data))
    )
    seen = observed.notnull().any("observable").values
    if records is not None:
        shown = rows.choose("records", records).shown
        seen &= np.isin(np.asarray(rows.records), shown)
    if not seen.any():
        raise ModelError("there must be data to compare with replicates, got none")
    replicates = replicates.transpose("chain", "draw", "time", "observable")
    return replicates.isel(time=seen), observed.isel(time=seen)


def picture_in_bins(
    draws: xr.DataArray, data: xr.DataArray, bins: Any, corrected: bool, **of_picture: Any
) -> PlotCollection:
    """Draw percentiles of the data in bins, and medians and 90 % bands of those of replicates."""
    known, number = data.notnull().values, _bin_of_rows(data["time"].values, bins)
    if corrected:
        factors = _corrections(draws, data, known, number)
        draws, data = draws * factors, data * factors
    of_draws, of_data = (_percentiles(one, known, number) for one in (draws, data))
    levels = over_draws(of_draws.to_dataset(name="replicates"))
    low, median, high = (levels.sel(quantile=q, method="nearest") for q in (0.05, 0.5, 0.95))
    ends = interval(low.drop_vars("quantile"), high.drop_vars("quantile"))
    below, above = [], [points_of(of_data.rename(percentile="path"), "data", DATA, "data")]
    for one in PERCENTILES:
        look = {**DRAWS, "alpha": OPACITIES[50 if one == 50 else 90], "width": 3.5}
        draw = bars if of_data.sizes["time"] == 1 else band
        below.append(Mark(draw, f"band_{one}", ends.sel(percentile=one), look, KEYS[one]))
        above.append(Mark(curve, f"median_{one}", median.sel(percentile=one), DRAWS))
        line = of_data.sel(percentile=one).to_dataset(name="data")
        above.append(Mark(curve, f"data_{one}", line, DATA))
    return picture_over_time(median.isel(percentile=0), [*below, *above], **of_picture)


def _bin_of_rows(times: np.ndarray, bins: Any) -> np.ndarray:
    """The number of the bin of each row, -1 outside the edges; rows of one time share a bin."""
    if is_integer(bins):
        n_bins = check_count("bins", bins, 1)
        _, at, n_rows = np.unique(times, return_inverse=True, return_counts=True)
        rank = np.cumsum(n_rows) - n_rows / 2  # of the middle of the rows of each time
        return np.floor(n_bins * rank[at] / times.size).astype(int)
    try:
        edges = np.asarray(bins, dtype=times.dtype if times.dtype.kind == "M" else "float64")
    except (TypeError, ValueError):
        edges = np.empty(0)
    if edges.ndim != 1 or edges.size < 2 or not (edges[1:] > edges[:-1]).all():
        raise ModelError(
            "bins must be a number of bins or their increasing edges, at least two and numbers or "
            f"dates as the times are, got {shortened(bins)}"
        )
    found = np.searchsorted(edges, times, side="right") - 1
    found[times == edges[-1]] = edges.size - 2
    found[times > edges[-1]] = -1
    if (found < 0).all():
        ends = [str(one) for one in (edges[0], edges[-1], times.min(), times.max())]
        raise ModelError("bins from {} to {} must have data, got those at {} to {}".format(*ends))
    return found


def _percentiles(array: xr.DataArray, known: np.ndarray, number: np.ndarray) -> xr.DataArray:
    """Percentiles of the known values in each bin, at the mean time of its rows; of each draw."""
    found, means = [], []
    for one in np.unique(number[number >= 0]):
        times = array["time"].values[number == one]
        means.append(times[0] + (times - times[0]).mean())  # numbers or dates
        for i in range(array.sizes["observable"]):
            values = array.values[..., known[:, i] & (number == one), i]
            none = np.full((len(PERCENTILES), *values.shape[:-1]), np.nan)
            found.append(np.percentile(values, PERCENTILES, axis=-1) if values.size else none)
    axis = ("time", np.array(means), array["time"].attrs)
    coords = {"time": axis, "observable": array["observable"], "percentile": list(PERCENTILES)}
    shape = (len(means), array.sizes["observable"], *found[0].shape)
    return xr.DataArray(np.reshape(found, shape), coords, (*coords, *array.dims[:-2]))


def _corrections(
    draws: xr.DataArray, data: xr.DataArray, known: np.ndarray, number: np.ndarray
) -> np.ndarray:
    """The median prediction of the bin of each row over the prediction of the row."""
    predicted = np.median(draws.values, axis=(0, 1))
    used = known & (number >= 0)[:, None]
    for what, values in (("data", data.values), ("predictions", predicted)):
        for row, i in np.argwhere(used & ~(values > 0)):
            name, time = names_of(data, "observable")[i], data["time"].values[row]
            raise ModelError(
                f"corrected needs positive {what}, got {values[row, i]:g} of {name!r} at time "
                f"{time}: leave that time out by edges as bins, or give transform=numpy.exp if "
                "these are logarithms"
            )
    factors = np.ones(data.shape)
    for one, i in np.ndindex(number.max() + 1, data.shape[1]):
        rows = used[:, i] & (number == one)
        if rows.any():
            factors[rows, i] = np.median(predicted[rows, i]) / predicted[rows, i]
    return factors


def _warn_of_same_records(
    idata: xr.DataTree, name: str, rows: Rows, model: pm.Model | None
) -> None:
    """Warn if what differs between records has the values of the posterior in the replicates.

    Without the model, a Deterministic is not known from a random variable, and one that has new
    values is enough.
    """
    if "posterior" not in idata.children:
        raise ModelError(
            "idata must have the posterior of a panel beside posterior_predictive: call "
            "pm.sample_posterior_predictive(idata, ..., extend_inferencedata=True)"
        )
    posterior, drawn = (idata[one].to_dataset() for one in ("posterior", "posterior_predictive"))
    n_records = np.unique(np.asarray(rows.records)).size
    own = [str(one) for one in posterior if n_records in posterior[one].shape[2:]]
    if model is not None:
        own = [one for one in own if one in [variable.name for variable in model.free_RVs]]
    kept = [one for one in own if one not in drawn or _agree(posterior[one], drawn[one])]
    if kept and (model is not None or kept == own):
        warnings.warn(
            f"{kept} differ between records, and posterior_predictive has no new draws of them: "
            "its data are of the same records, and show nothing of the population. Call "
            f"pm.sample_posterior_predictive(idata, sample_vars={[*own, name]}, "
            "extend_inferencedata=True)",
            ModelWarning,
            skip_file_prefixes=INSIDE,
        )


def _agree(one: xr.DataArray, other: xr.DataArray) -> bool:
    """Whether there are draws that both have, and they are the same."""
    one, other = xr.align(one, other, join="inner")
    return one.size > 0 and one.shape == other.shape and np.allclose(one, other)
