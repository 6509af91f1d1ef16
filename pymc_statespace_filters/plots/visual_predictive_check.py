"""Percentiles of the data in bins of time, pooled over records, beside those of replicates."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from arviz_plots import PlotCollection

from ..errors import ModelError, ModelWarning, warn
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
) -> tuple[xr.DataArray, xr.DataArray, xr.DataArray]:
    """Return replicates, data and their flags, of rows with data, over "time" and "observable".

    A flag is -1 where a true value lies below the limit that is its datum, 1 where above, or 0.
    """
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
    constant = idata["constant_data"].to_dataset() if "constant_data" in idata.children else {}
    censored = constant.get(f"{name}_censored", xr.zeros_like(data[name]))
    flags = observed.copy(data=censored.values)
    seen = observed.notnull().any("observable").values
    if records is not None:
        shown = rows.choose("records", records).shown
        seen &= np.isin(np.asarray(rows.records), shown)
    if not seen.any():
        raise ModelError("there must be data to compare with replicates, got none")
    replicates = replicates.transpose("chain", "draw", "time", "observable")
    return replicates.isel(time=seen), observed.isel(time=seen), flags.isel(time=seen)


def picture_in_bins(
    draws: xr.DataArray,
    data: xr.DataArray,
    flags: xr.DataArray,
    bins: Any,
    corrected: bool,
    labels: Sequence[str],
    **of_picture: Any,
) -> PlotCollection:
    """Draw percentiles of the data in bins, and medians and 90 % bands of those of replicates."""
    of_draws, of_data = _in_bins(draws, data, flags, bins, corrected)
    labels = [f"corrected {label}" for label in labels] if corrected else list(labels)
    labels += names_of(of_data, "observable")[len(labels) :]
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
    return picture_over_time(median.isel(percentile=0), [*below, *above], labels, **of_picture)


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


def _in_bins(
    draws: xr.DataArray, data: xr.DataArray, flags: xr.DataArray, bins: Any, corrected: bool
) -> list[xr.DataArray]:
    """Percentiles of each draw and of the data in bins, at the mean times of their rows.

    Behind the observables are the shares below the limit of those that have a single one.
    """
    number, names = _bin_of_rows(data["time"].values, bins), names_of(data, "observable")
    limits = [np.unique(data.values[flags.values[:, i] < 0, i]) for i in range(len(names))]
    single = [(i, limit[0]) for i, limit in enumerate(limits) if limit.size == 1]
    none = np.full((3, *draws.shape[:2]), np.nan), np.full(3, np.nan)
    means, found = [], []
    for one in np.unique(number[number >= 0]):
        times = data["time"].values[number == one]
        means.append(times[0] + (times - times[0]).mean())  # numbers or dates
        for i, limit in [*((i, None) for i in range(len(names))), *single]:
            at = {"time": data[:, i].notnull().values & (number == one), "observable": i}
            replicates, values, flag = draws.isel(at), data.isel(at), flags.isel(at).values
            if not values.size:
                found.append(none)
            elif limit is None:
                found.append(_percentiles(replicates, values, flag, corrected))
            else:
                found.append(_shares(replicates.values < limit, flag < 0))
    coords = {
        "time": ("time", np.array(means), data["time"].attrs),
        "observable": [*names, *(f"share of {names[i]} below its limit" for i, _ in single)],
        "percentile": list(PERCENTILES),
    }
    shape = (len(means), len(names) + len(single), len(PERCENTILES))
    of_draws, of_data = (np.array(values) for values in zip(*found, strict=True))
    return [
        xr.DataArray(values.reshape(*shape, *values.shape[2:]), coords, (*coords, *dims))
        for values, dims in ((of_draws, draws.dims[:2]), (of_data, ()))
    ]


def _percentiles(
    draws: xr.DataArray, data: xr.DataArray, flags: np.ndarray, corrected: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Percentiles of the rows of a bin, of each draw (3, chain, draw) and of the data (3,)."""
    factors = _corrections(draws, data) if corrected else 1.0
    values = data.values * factors
    # What a limit leaves open is beyond all others, and a percentile there is not drawn.
    lower = values[flags < 0].max(initial=-np.inf)
    upper = values[flags > 0].min(initial=np.inf)
    values = np.where((flags < 0) | (values < lower), -np.inf, values)
    values = np.where((flags > 0) | (values > upper), np.inf, values)
    with np.errstate(invalid="ignore"):
        of_data = np.percentile(values, PERCENTILES)
    of_draws = np.percentile(draws.values * factors, PERCENTILES, axis=-1)
    return of_draws, np.where(np.isfinite(of_data), of_data, np.nan)


def _shares(draws: np.ndarray, data: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The shares of the rows of a bin that lie below the limit, in the place of medians."""
    of_draws, of_data = draws.mean(axis=-1), data.mean()
    none = np.full_like(of_draws, np.nan)
    return np.stack([none, of_draws, none]), np.array([np.nan, of_data, np.nan])


def _corrections(draws: xr.DataArray, data: xr.DataArray) -> np.ndarray:
    """The median prediction of a bin over the prediction of each of its rows."""
    predicted = np.median(draws.values, axis=(0, 1))
    for what, values in (("data", data.values), ("predictions", predicted)):
        for row in np.flatnonzero(~(values > 0)):
            name, time = str(data["observable"].values), data["time"].values[row]
            raise ModelError(
                f"corrected needs positive {what}, got {values[row]:g} of {name!r} at time {time}: "
                "leave that time out by edges as bins, or give transform=numpy.exp if these are "
                "logarithms"
            )
    return np.median(predicted) / predicted


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
        warn(
            f"{kept} differ between records, and posterior_predictive has no new draws of them: "
            "its data are of the same records, and show nothing of the population. Call "
            f"pm.sample_posterior_predictive(idata, sample_vars={[*own, name]}, "
            "extend_inferencedata=True)",
            ModelWarning,
        )


def _agree(one: xr.DataArray, other: xr.DataArray) -> bool:
    """Whether there are draws that both have, and they are the same."""
    one, other = xr.align(one, other, join="inner")
    return one.size > 0 and one.shape == other.shape and np.allclose(one, other)
