"""Axes: labels with units, and ticks."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object
from arviz_plots.visuals import labelled_x

STEPS = (1.0, 2.0, 5.0, 10.0)  # between ticks, times a power of ten


def with_unit(label: str, unit: str | None) -> str:
    """Return the label of an axis, with the unit if it is known."""
    return f"{label} ({unit})" if unit else label


def unit_of(name: str, *arrays: xr.DataArray | None) -> str | None:
    """Return the unit of a state or observable, from the first array that tells it.

    It is ``attrs["units"]`` of the array or of its last coordinate: a text for all names, a list in
    their order, or a mapping.
    """
    for array in arrays:
        if array is None or name not in array[array.dims[-1]].values:
            continue
        names = array[array.dims[-1]]
        for units in (array.attrs.get("units"), names.attrs.get("units")):
            if isinstance(units, str):
                return units
            if isinstance(units, Mapping):
                by_name = dict(units)
            else:
                by_name = {} if units is None else dict(zip(names.values, units, strict=False))
            if name in by_name:
                return str(by_name[name])
    return None


def time_label(*arrays: xr.DataArray | None) -> str:
    """Return the label of the time axis, with the unit of the first array that has one."""
    units = (array["time"].attrs.get("units") for array in arrays if array is not None)
    return with_unit("time", next((str(unit) for unit in units if unit is not None), None))


def label_axes(collection: PlotCollection, names: Sequence[str], time: str) -> None:
    """Label the y axis of each panel, and the time axis below the lowest panels."""
    (dim,) = collection.viz["plot"].dims
    texts = xr.DataArray(list(names), coords={dim: collection.data[dim]}, dims=[dim])
    panels = xr.zeros_like(texts, dtype=float).to_dataset(name=next(iter(collection.data)))
    collection.map(label_y, "y_label", data=panels, ignore_aes="all", texts=texts)
    n_columns = int(collection.viz["col_index"].max()) + 1
    lowest = panels.isel({dim: slice(-n_columns, None)})
    settings = {"ignore_aes": "all", "store_artist": False}
    collection.map(labelled_x, data=lowest, text=time, **settings)


def label_y(da: xr.DataArray, target: Any, *, texts: xr.DataArray, **kwargs: Any) -> Any:
    """Label the y axis of a panel with its text."""
    return backend_from_object(target).ylabel(texts.item(), target, **kwargs)


def label_x(da: xr.DataArray, target: Any, *, texts: xr.DataArray, **kwargs: Any) -> Any:
    """Label the x axis of a panel with its text."""
    return backend_from_object(target).xlabel(texts.item(), target, **kwargs)


def few_ticks(da: xr.DataArray, target: Any, *, n_ticks: int) -> None:
    """Set at most `n_ticks` ticks at the x axis of values along the dimension "plot_axis"."""
    x = da.sel(plot_axis="x").values
    ticks = linear_ticks(np.nanmin(x), np.nanmax(x), n_ticks)
    backend_from_object(target).xticks(ticks["values"], ticks["labels"], target)


def label_ticks(da: xr.DataArray, target: Any, *, ticks: dict[str, Any]) -> None:
    """Set positions and labels of the ticks at the y axis."""
    backend_from_object(target).yticks(ticks["values"], ticks["labels"], target)


def label_rows(da: xr.DataArray, target: Any, *, places: np.ndarray, names: list[str]) -> None:
    """Label the rows at the y axis, with space above and below."""
    drawing = backend_from_object(target)
    drawing.ylim((-0.5, len(names) - 0.3), target)
    drawing.yticks(places, names, target)


def linear_ticks(low: float, high: float, n_ticks: int) -> dict[str, Any]:
    """Return positions and labels of at most `n_ticks` round numbers from `low` to `high`."""
    width = high - low if high > low else max(abs(high), 1.0) / 10
    power = 10.0 ** math.floor(math.log10(width / n_ticks))
    for step in (power * step for step in STEPS):
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        if last - first < n_ticks:
            break
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    values = np.round(np.arange(first, last + 1) * step, digits) + 0.0  # no -0
    return {"values": values, "labels": [f"{value:.{digits}f}" for value in values]}


def logarithmic_ticks(logs: np.ndarray) -> dict[str, Any]:
    """Return tick positions (log10) and labels: decades, or finer if there are few decades."""
    low, high = logs.min() - 1e-9, logs.max() + 1e-9
    digits = (1,) if high - low > 3 else (1, 3) if high - low > 1.5 else (1, 2, 5)
    decades = range(math.floor(low), math.ceil(high) + 1)
    values = [digit * 10.0**decade for decade in decades for digit in digits]
    shown = [value for value in values if low <= math.log10(value) <= high]
    return {"values": np.log10(shown), "labels": [f"{value:g}" for value in shown]}
