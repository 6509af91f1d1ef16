"""Elements shared by the plots: figures, labelled rows, curves, bands, annotations and ticks."""

import math
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np
import xarray as xr
from arviz_base import rcParams
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object

BOUND = "ci_bound"
PANELS_IN_LINE = 4
DOTS_PER_INCH = 100  # of backends that measure in dots


def canvas(
    data: xr.Dataset,
    *,
    backend: str | None,
    pc_kwargs: Mapping[str, Any],
    aes: Mapping[str, list[str]],
    height: float = 2.5,
    size: tuple[float, float] | None = None,
    n_panels: int = 1,
    panels_in_line: int = PANELS_IN_LINE,
    legend: bool = False,
    **defaults: Any,
) -> PlotCollection:
    """Make an empty figure for `data`; `pc_kwargs` of the user override the defaults.

    Parameters
    ----------
    data, backend, pc_kwargs
        As in the public functions.
    aes : mapping of str to list of str
        Aesthetics and the dimensions that they encode.
    height : float
        Height of a panel in rows, the unit of ``scale_fig_size`` in arviz_plots.
    size : tuple of float, optional
        Width and height of the figure in inches; by default derived from the panels.
    n_panels, panels_in_line : int
    legend : bool
        Whether to leave room for a legend beside the panels.
    **defaults
        Default arguments of `PlotCollection.wrap`.
    """
    backend = rcParams["plot.backend"] if backend is None else backend
    drawing = import_module(f"arviz_plots.backend.{backend}")
    figure = dict(pc_kwargs.get("figure_kwargs", {}))
    n_lines = math.ceil(n_panels / panels_in_line)
    if "figsize" not in figure and size is not None and backend == "matplotlib":
        figure["figsize"] = size
    elif "figsize" not in figure:
        n_columns = min(n_panels, panels_in_line) + (0.5 if legend else 0.0)
        dots = size and (DOTS_PER_INCH * size[0], DOTS_PER_INCH * size[1])
        figure["figsize"] = drawing.scale_fig_size(
            dots, rows=height * n_lines, cols=n_columns, figsize_units=dots and "dots"
        )
        figure["figsize_units"] = "dots"
    if backend == "matplotlib":  # the only backend that needs it to make room for a legend
        figure.setdefault("layout", "constrained")
    if backend == "plotly" and size is not None:  # its default leaves room for titles
        figure.setdefault("vertical_spacing", 0.25 / n_lines)
    given = {
        "col_wrap": panels_in_line,
        **defaults,
        **pc_kwargs,
        "figure_kwargs": figure,
        "backend": backend,
    }
    given["aes"] = {**aes, **pc_kwargs.get("aes", {})}
    return PlotCollection.wrap(data, **given)


def canvas_of_rows(
    data: xr.Dataset, *, backend: str | None, pc_kwargs: Mapping[str, Any]
) -> PlotCollection:
    """Make a figure with one labelled row per entry of the only dimension, the first on top."""
    (dim,) = map(str, data.dims)
    places = np.arange(data.sizes[dim])[::-1]
    collection = canvas(
        data,
        backend=backend,
        pc_kwargs=pc_kwargs,
        aes={"y": [dim]},
        height=0.6 + 0.3 * len(places),
        y=places,
    )
    names = [str(name) for name in data[dim].values]
    collection.map(label_rows, ignore_aes="all", places=places, names=names, store_artist=False)
    return collection


def label_rows(da: xr.DataArray, target: Any, *, places: np.ndarray, names: list[str]) -> None:
    """Label the rows at the y axis, with space above and below."""
    drawing = backend_from_object(target)
    drawing.ylim((-0.5, len(names) - 0.3), target)
    drawing.yticks(places, names, target)


def curve(da: xr.DataArray, target: Any, **kwargs: Any) -> Any:
    """Plot values against the coordinate of their only dimension."""
    (dim,) = da.dims
    return backend_from_object(target).line(da[dim].values, da.values, target, **kwargs)


def band(da: xr.DataArray, target: Any, **kwargs: Any) -> Any:
    """Fill between the two curves along the dimension `BOUND`; return the last part.

    Gaps are left out by filling each contiguous part separately, as some backends fill a polygon.
    """
    (dim,) = (dim for dim in da.dims if dim != BOUND)
    low, high = da.transpose(BOUND, dim).values
    fill = backend_from_object(target).fill_between_y
    filled = None
    for part in np.ma.clump_unmasked(np.ma.masked_invalid(low + high)):
        filled = fill(da[dim].values[part], low[part], high[part], target, **kwargs)
    return filled


def interval(low: xr.Dataset, high: xr.Dataset) -> xr.Dataset:
    """Concatenate lower and upper ends along the dimension `BOUND`."""
    return xr.concat([low, high], dim=BOUND).assign_coords({BOUND: ["lower", "upper"]})


def annotate(
    da: xr.DataArray,
    target: Any,
    *,
    y: Any,
    texts: xr.DataArray,
    middle: float,
    **kwargs: Any,
) -> Any:
    """Write a text above the point of a row, extending towards the middle of the panel."""
    return backend_from_object(target).text(
        da.item(),
        np.asarray(y).item() + 0.15,
        texts.item(),
        target,
        horizontal_align="right" if da.item() > middle else "left",
        vertical_align="bottom",
        **kwargs,
    )


def logarithmic_ticks(logs: np.ndarray) -> dict[str, Any]:
    """Return tick positions (log10) and labels: decades, or finer if there are few decades."""
    low, high = logs.min() - 1e-9, logs.max() + 1e-9
    digits = (1,) if high - low > 3 else (1, 3) if high - low > 1.5 else (1, 2, 5)
    decades = range(math.floor(low), math.ceil(high) + 1)
    values = [digit * 10.0**decade for decade in decades for digit in digits]
    shown = [value for value in values if low <= math.log10(value) <= high]
    return {"values": np.log10(shown), "labels": [f"{value:g}" for value in shown]}


def format_probability(prob: float) -> str:
    """Format a probability with enough digits near zero and near one."""
    if prob < 1e-6:
        return "< 1e-6"
    if prob < 0.01:
        return f"{prob:.1g}"
    return f"{prob:.2f}" if prob < 0.99 else f"{prob:.4f}"
