"""Elements shared by the plots: figures, labelled rows, curves, bands and annotations."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from arviz_base import rcParams
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object

from .axes import STEPS, label_rows
from .legend import DOTS_PER_INCH

BOUND = "ci_bound"
PANELS_IN_LINE = 4
# Of an axis, at most: between them labels of years have room.
N_TICKS, TICKS_PER_INCH = 8, 1.4


def canvas(
    data: xr.Dataset,
    *,
    backend: str | None,
    pc_kwargs: Mapping[str, Any],
    aes: Mapping[str, list[str]],
    size: tuple[float, float],
    n_panels: int = 1,
    panels_in_line: int = PANELS_IN_LINE,
    **defaults: Any,
) -> PlotCollection:
    """Make an empty figure for `data`; `pc_kwargs` of the user override the defaults.

    Parameters
    ----------
    data, backend, pc_kwargs
        As in the public functions.
    aes : mapping of str to list of str
        Aesthetics and the dimensions that they encode.
    size : tuple of float
        Width and height of the figure in inches.
    n_panels, panels_in_line : int
    **defaults
        Default arguments of `PlotCollection.wrap`.
    """
    backend = rcParams["plot.backend"] if backend is None else backend
    figure = dict(pc_kwargs.get("figure_kwargs", {}))
    if "figsize" not in figure:
        in_inches = backend == "matplotlib"
        scale = 1.0 if in_inches else DOTS_PER_INCH
        figure["figsize"] = (scale * size[0], scale * size[1])
        figure["figsize_units"] = "inches" if in_inches else "dots"
    if backend == "matplotlib":  # the only backend that needs it to make room for a legend
        figure.setdefault("layout", "constrained")
    if backend == "plotly":  # its default leaves room for titles
        figure.setdefault("vertical_spacing", 0.25 / math.ceil(n_panels / panels_in_line))
    given = {
        "col_wrap": panels_in_line,
        **defaults,
        **pc_kwargs,
        "figure_kwargs": figure,
        "backend": backend,
    }
    given["aes"] = {**aes, **pc_kwargs.get("aes", {})}
    collection = PlotCollection.wrap(data, **given)
    if backend == "matplotlib":  # the others write numbers in full
        drawn = collection.viz["figure"].item()
        in_line = min(n_panels, panels_in_line)
        n_ticks = min(N_TICKS, max(2, int(TICKS_PER_INCH * drawn.get_figwidth() / in_line)))
        for axes in drawn.axes:
            axes.ticklabel_format(useOffset=False)
            # Its own ticks, such as 1902.5, touch each other.
            axes.locator_params(axis="x", nbins=n_ticks, steps=STEPS)
    return collection


def size_of_panels(n_panels: int) -> tuple[float, float]:
    """Return the size in inches of a figure of panels side by side, below a legend."""
    n_columns = min(n_panels, PANELS_IN_LINE)
    return max(3.8 * n_columns, 6.0), 0.8 + 2.8 * math.ceil(n_panels / PANELS_IN_LINE)


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
        size=(6.4, 1.3 + 0.6 * len(places)),
        y=places,
    )
    names = [str(name) for name in data[dim].values]
    collection.map(label_rows, ignore_aes="all", places=places, names=names, store_artist=False)
    return collection


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


def format_probability(prob: float) -> str:
    """Format a probability with enough digits near zero and near one."""
    if prob < 1e-6:
        return "< 1e-6"
    if prob < 0.01:
        return f"{prob:.1g}"
    return f"{prob:.2f}" if prob < 0.99 else f"{prob:.4f}"
