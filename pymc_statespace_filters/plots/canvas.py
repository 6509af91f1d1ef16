"""Elements shared by the plots: figures, axes, labelled rows, curves, annotations."""

import math
from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np
import xarray as xr
from arviz_base import rcParams
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object
from arviz_plots.visuals import labelled_x

from .legend import DOTS_PER_INCH, further_lines

STEPS = (1.0, 2.0, 5.0, 10.0)  # between ticks, times a power of ten

N_COLORS = 8  # that every backend tells apart
BOUND = "ci_bound"
PANELS_IN_LINE = 4
TITLE_WIDTH, TITLE_SIZE = 36, 10  # of a line in letters, and of a letter in points
LONGEST_NAME, INCHES_PER_LETTER = 24, 0.08  # in letters, of an axis
# Of an axis, at most: between them labels of years have room.
N_TICKS, TICKS_PER_INCH = 8, 1.4


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


def label_axes(
    collection: PlotCollection, names: Sequence[str], time: str, titles: Sequence[str] = ()
) -> None:
    """Label the y axis of each panel, and the time axis below the lowest panels.

    ``titles`` are the records in the names. A name that is longer than its axis is a title too.
    """
    short = list(names)
    if titles:
        short = [name.replace(f"{one}: ", "", 1) for name, one in zip(names, titles, strict=True)]
    if max(map(len, short)) > LONGEST_NAME:
        titles, short = names, [""] * len(short)
    (dim,) = collection.viz["plot"].dims
    texts = xr.DataArray(short, coords={dim: collection.data[dim]}, dims=[dim])
    panels = xr.zeros_like(texts, dtype=float).to_dataset(name=next(iter(collection.data)))
    n_columns = int(collection.viz["col_index"].max()) + 1
    if titles:
        width = TITLE_WIDTH if n_columns > 1 else 2 * TITLE_WIDTH
        broken = texts.copy(data=[fill(title, width) for title in titles])
        collection.map(label_title, "title", data=panels, ignore_aes="all", texts=broken)
    collection.map(label_y, "y_label", data=panels, ignore_aes="all", texts=texts)
    lowest = panels.isel({dim: slice(-n_columns, None)})
    settings = {"ignore_aes": "all", "store_artist": False}
    collection.map(labelled_x, data=lowest, text=time, **settings)
    shorten_dates(collection)


def shorten_dates(collection: PlotCollection) -> None:
    """Shorten dates below an axis, which touch each other in matplotlib."""
    if collection.backend != "matplotlib":
        return
    from matplotlib.dates import AutoDateFormatter, AutoDateLocator, ConciseDateFormatter

    for axes in collection.viz["figure"].item().axes:
        if isinstance(axes.xaxis.get_major_formatter(), AutoDateFormatter):
            locator = AutoDateLocator(maxticks=N_TICKS)
            axes.xaxis.set_major_locator(locator)
            axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))


def label_y(da: xr.DataArray, target: Any, *, texts: xr.DataArray, **kwargs: Any) -> Any:
    """Label the y axis of a panel with its text."""
    return backend_from_object(target).ylabel(texts.item(), target, **kwargs)


def label_title(da: xr.DataArray, target: Any, *, texts: xr.DataArray, **kwargs: Any) -> Any:
    """Write the title of a panel, whose lines every backend breaks in its own way."""
    drawing = backend_from_object(target)
    line = "<br>" if drawing.__name__.endswith("plotly") else "\n"
    return drawing.title(texts.item().replace("\n", line), target, size=TITLE_SIZE, **kwargs)


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


def canvas(
    data: xr.Dataset,
    *,
    backend: str | None,
    pc_kwargs: Mapping[str, Any],
    aes: Mapping[str, list[str]],
    size: tuple[float, float],
    n_panels: int = 1,
    panels_in_line: int = PANELS_IN_LINE,
    key: Sequence[str] = (),
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
    key : sequence of str
        Entries of a legend, for whose further lines the figure is higher.
    **defaults
        Default arguments of `PlotCollection.wrap`.
    """
    backend = rcParams["plot.backend"] if backend is None else backend
    figure = dict(pc_kwargs.get("figure_kwargs", {}))
    if "figsize" not in figure:
        in_inches = backend == "matplotlib"
        scale = 1.0 if in_inches else DOTS_PER_INCH
        height = size[1] + further_lines(key, size[0])
        figure["figsize"] = (scale * size[0], scale * height)
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
    names = [str(name) for name in data[dim].values]
    for_names = INCHES_PER_LETTER * max(0, max(map(len, names), default=0) - LONGEST_NAME)
    collection = canvas(
        data,
        backend=backend,
        pc_kwargs=pc_kwargs,
        aes={"y": [dim]},
        size=(6.4 + for_names, 1.3 + 0.6 * len(places)),
        y=places,
    )
    collection.map(label_rows, ignore_aes="all", places=places, names=names, store_artist=False)
    return collection


def style_of_curve(i: int) -> dict[str, str]:
    """Return colour and line of a curve, of which no two of 32 curves share both."""
    return {"color": f"C{i % N_COLORS}", "linestyle": f"C{i // N_COLORS}"}


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
