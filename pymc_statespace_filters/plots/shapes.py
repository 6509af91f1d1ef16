"""What a mark draws in one panel: curves, bands, bars and points, and the ticks of an axis."""

import math
from collections.abc import Hashable
from typing import Any

import numpy as np
import xarray as xr
from arviz_plots.plot_collection import backend_from_object

BOUND = "ci_bound"
EXPECTED = {"color": "B3", "alpha": 0.3}  # what a correct model or filter would give
ZERO = {"color": "B2", "width": 0.8}
FEW = 200  # observations that fit beside each other as separate marks
DIAMETER, LEAST_DIAMETER, LEAST_ALPHA = 4.0, 2.0, 0.6  # of points


def interval(low: xr.Dataset, high: xr.Dataset) -> xr.Dataset:
    """Concatenate lower and upper ends along the dimension `BOUND`."""
    return xr.concat([low, high], dim=BOUND).assign_coords({BOUND: ["lower", "upper"]})


def from_zero(values: xr.Dataset) -> xr.Dataset:
    """Intervals from zero to the values, as bars show them."""
    return interval(xr.zeros_like(values).where(values.notnull()), values)


def curve(da: xr.DataArray, target: Any, **kwargs: Any) -> Any:
    """Draw values against the coordinate of their only dimension."""
    (dim,) = da.dims
    return backend_from_object(target).line(da[dim].values, da.values, target, **kwargs)


def band(da: xr.DataArray, target: Any, *, color: Any, alpha: float, **of_curve: Any) -> Any:
    """Fill between the two curves along the dimension `BOUND`; return the last part.

    Of each value if there is a dimension "value". Gaps are left out by filling each contiguous part
    separately, as some backends fill a polygon. It has the colour of a curve, not its line.
    """
    if "value" in da.dims:
        return [band(one, target, color=color, alpha=alpha) for one in da.transpose("value", ...)][
            -1
        ]
    dim = _dim_of(da, BOUND)
    low, high = da.transpose(BOUND, dim).values
    fill = backend_from_object(target).fill_between_y
    filled = None
    for part in np.ma.clump_unmasked(np.ma.masked_invalid(low + high)):
        filled = fill(da[dim].values[part], low[part], high[part], target, color=color, alpha=alpha)
    return filled


def bars(da: xr.DataArray, target: Any, **kwargs: Any) -> Any:
    """Draw a vertical line between the bounds at each time."""
    dim = _dim_of(da, BOUND)
    low, high = da.transpose(BOUND, dim).values
    return _broken_line([da[dim].values] * 2, [low, high], target, **kwargs)


def paths(da: xr.DataArray, target: Any, **kwargs: Any) -> Any:
    """Draw each path as a line over time."""
    dim = _dim_of(da, "path")
    values = da.transpose(dim, "path").values
    times = np.repeat(da[dim].values[:, None], values.shape[1], axis=1)
    return _broken_line(times, values, target, **kwargs)


def points(da: xr.DataArray, target: Any, *, diameter: float, **kwargs: Any) -> Any:
    """Draw values over time, those of all paths if there is a dimension "path"; or y against x.

    Of the latter there is a dimension "plot_axis".
    """
    if "plot_axis" in da.dims:
        x, y = da.sel(plot_axis="x"), da.sel(plot_axis="y")
    else:
        x, y = xr.broadcast(da[_dim_of(da, "path")], da)
    known = (x.notnull() & y.notnull()).values
    drawing = backend_from_object(target)
    size = diameter if drawing.__name__.endswith("bokeh") else diameter**2  # other backends: area
    return drawing.scatter(x.values[known], y.values[known], target, size=size, **kwargs)


def point_size(values: xr.DataArray) -> dict[str, Any]:
    """Return size and opacity of points over time: the more, the smaller and paler."""
    n_points = max(int(values.count("time").max()), 1)
    share = min(1.0, FEW / n_points)
    return {
        "diameter": max(DIAMETER * share**0.5, LEAST_DIAMETER),
        "alpha": max(share**0.25, LEAST_ALPHA),
        "width": 0,  # of the edge
    }


def y_ticks(da: xr.DataArray, target: Any, *, values: Any, labels: list[str]) -> None:
    """Set positions and labels of the ticks at the y axis."""
    backend_from_object(target).yticks(values, labels, target)


def logarithmic_ticks(logs: np.ndarray) -> dict[str, Any]:
    """Return tick positions (log10) and labels: decades, or finer if there are few decades."""
    low, high = logs.min() - 1e-9, logs.max() + 1e-9
    digits = (1,) if high - low > 3 else (1, 3) if high - low > 1.5 else (1, 2, 5)
    decades = range(math.floor(low), math.ceil(high) + 1)
    values = [digit * 10.0**decade for decade in decades for digit in digits]
    shown = [value for value in values if low <= math.log10(value) <= high]
    return {"values": np.log10(shown), "labels": [f"{value:g}" for value in shown]}


def _dim_of(da: xr.DataArray, *others: str) -> Hashable:
    (dim,) = (dim for dim in da.dims if dim not in others)
    return dim


def _broken_line(x: Any, y: Any, target: Any, **kwargs: Any) -> Any:
    """Draw the columns of y against those of x as one line with gaps."""
    x, y = np.asarray(x), np.asarray(y)
    x = np.concatenate([x, x[-1:]])  # numbers or dates; y alone breaks the line
    y = np.concatenate([y, np.full((1, y.shape[1]), np.nan)])
    return backend_from_object(target).line(x.T.ravel(), y.T.ravel(), target, **kwargs)
