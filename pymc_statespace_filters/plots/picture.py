"""The builder of every plot: panels with marks, their labels, and a key beside them."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from importlib import import_module
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from arviz_base import rcParams
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object
from arviz_plots.visuals import hspan, scatter_x

from .shapes import band, points

DOTS_PER_INCH = 100
LETTERS_PER_INCH = 11.0
SAMPLE, LINE, LABELS = 0.6, 0.25, 0.6  # inches: beside and of an entry of the key; below panels
LONGEST_NAME = 24  # letters, of a line beside an axis
SIZE_OF_TITLES = 10  # points
STEPS = (1.0, 2.0, 5.0, 10.0)  # between ticks, times a power of ten
N_COLORS = 8  # that every backend tells apart


class Mark(NamedTuple):
    """What is drawn into each panel in which its data have values.

    A mark without a value in any panel is not drawn, has no name and no entry in the key.
    """

    draw: Callable[..., Any]
    name: str | None  # of the visual; none for a setting of axes
    data: xr.Dataset
    style: Mapping[str, Any] = {}
    key: str | Mapping[str, str] = ""  # entry in the key, or those of models by their names


def picture(
    panels: xr.Dataset,
    marks: Sequence[Mark],
    *,
    x: Any,
    y: Any,
    title: Any = "",
    cols: Sequence[Any] = (),
    size: tuple[float, float] = (7.0, 2.0),
    in_line: int = 1,
    backend: str | None,
    pc_kwargs: Mapping[str, Any],
    aesthetics: Mapping[str, Any] = {},
) -> PlotCollection:
    """Draw marks in panels, those that come later above the others, with a key to the right.

    The texts ``x``, ``y`` and ``title`` are the same for all panels, mappings by variable of
    ``panels``, or arrays along ``cols``, the dimensions along which panels differ, "__variable__"
    among them. One for all at the x axis is written below the lowest panels. ``size`` is that of a
    panel in inches, of which ``in_line`` are beside each other. ``backend`` and ``pc_kwargs`` are
    as in the public functions: what the user gives overrides what is here, and the ``aesthetics``,
    of `PlotCollection.wrap`.
    """
    marks = [one for one in marks if any(a.notnull().any() for a in one.data.values())]
    frames = _frames(panels, cols)
    n_panels = sum(frame.size for frame in frames.values())
    in_line = pc_kwargs.get("col_wrap", min(in_line, n_panels))
    n_lines = math.ceil(n_panels / in_line)
    backend = rcParams["plot.backend"] if backend is None else backend
    entries = [one for mark in marks for one in _entries(mark)]
    width = in_line * size[0] + _inches(entries)
    height = max(n_lines * size[1] + LABELS, LINE * (len(entries) + 1))
    wrapped = {"col_wrap": in_line, "cols": list(cols), **aesthetics, **pc_kwargs}
    wrapped["figure_kwargs"] = _figure(backend, (width, height), n_lines, pc_kwargs)
    wrapped["aes"] = {**aesthetics.get("aes", {}), **pc_kwargs.get("aes", {})}
    collection = PlotCollection.wrap(panels, backend=backend, **wrapped)
    along = {dim for dims in wrapped["aes"].values() for dim in dims}
    for mark in marks:
        ignored = () if mark.name and along <= set(mark.data.dims) else "all"
        settings = {"ignore_aes": ignored, "store_artist": mark.name is not None}
        collection.map(mark.draw, mark.name, data=mark.data, **settings, **mark.style)
    below = _below(frames, x, in_line) if isinstance(x, str) else _texts(frames, x)
    n_letters = int(LETTERS_PER_INCH * size[0])
    for where, text, longest in (
        ("x_label", below, n_letters),
        ("y_label", _texts(frames, y), LONGEST_NAME),
        ("title", _texts(frames, title), n_letters),
    ):
        if (text != "").to_array().any():
            style = {"where": where.replace("_", ""), "text": text, "longest": longest}
            collection.map(write, where, data=frames, ignore_aes="all", **style)
    _draw_key(collection, marks)
    _space_ticks(collection, in_line)
    return collection


def write(da: xr.DataArray, target: Any, *, where: str, text: xr.DataArray, longest: int) -> Any:
    """Write the text of a panel, in lines that are not longer than its side."""
    drawing = backend_from_object(target)
    line = "<br>" if drawing.__name__.endswith("plotly") else "\n"
    lines = "\n".join(fill(part, longest) for part in text.item().split("\n"))
    size = {"size": SIZE_OF_TITLES} if where == "title" else {}
    return getattr(drawing, where)(lines.replace("\n", line), target, **size)


def with_unit(label: str, unit: str | None) -> str:
    """Return the label of an axis, with the unit if it is known."""
    return f"{label} ({unit})" if unit else label


def style_of_curve(i: int) -> dict[str, str]:
    """Return colour and line of a curve, of which no two of 32 curves share both."""
    return {"color": f"C{i % N_COLORS}", "linestyle": f"C{i // N_COLORS}"}


def along_models(styles: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return aesthetics of `picture`: the style of each model along "model"."""
    keys = {key: [style[key] for style in styles] for key in styles[0]}
    return {"aes": {key: ["model"] for key in keys}, **keys}


def titles_of(panels: xr.Dataset, dims: Sequence[Any]) -> Any:
    """Return what distinguishes panels along some dimensions, in a line for each of them."""
    labels = [panels[dim] for dim in dims]
    texts = [one.copy(data=np.array([str(name) for name in one.values], object)) for one in labels]
    return reduce(lambda above, text: above + "\n" + text, texts) if texts else ""


def _frames(panels: xr.Dataset, cols: Sequence[Any]) -> xr.Dataset:
    """A zero for each panel."""
    return xr.Dataset(
        {
            name: xr.zeros_like(
                array.isel({dim: 0 for dim in array.dims if dim not in cols}, drop=True), float
            )
            for name, array in panels.items()
        }
    )


def _texts(frames: xr.Dataset, given: Any) -> xr.Dataset:
    """The text of each panel."""

    def of(frame: xr.DataArray) -> xr.DataArray:
        text = given.get(frame.name, "") if isinstance(given, Mapping) else given
        if isinstance(text, xr.DataArray):
            return text
        return xr.full_like(frame, text, dtype=object)

    return frames.map(of)


def _below(frames: xr.Dataset, text: str, in_line: int) -> xr.Dataset:
    """The text for the lowest panels, and none for the others."""
    found, n_left = {}, sum(frame.size for frame in frames.values())
    for name, frame in frames.items():
        from_last = n_left - np.arange(frame.size).reshape(frame.shape)
        found[name] = frame.copy(data=np.where(from_last <= in_line, text, ""))
        n_left -= frame.size
    return xr.Dataset(found)


def _figure(
    backend: str, size: tuple[float, float], n_lines: int, pc_kwargs: Mapping[str, Any]
) -> dict[str, Any]:
    """Settings of the figure: its size, unless the user has one, and the room between panels."""
    figure = dict(pc_kwargs.get("figure_kwargs", {}))
    if "figsize" not in figure:
        in_inches = backend == "matplotlib"
        scale = 1.0 if in_inches else DOTS_PER_INCH
        figure["figsize"] = (scale * size[0], scale * size[1])
        figure["figsize_units"] = "inches" if in_inches else "dots"
    if backend == "matplotlib":  # the only backend that needs it to make room for a key
        figure.setdefault("layout", "constrained")
    if backend == "plotly":  # its default leaves room for titles
        figure.setdefault("vertical_spacing", 0.25 / n_lines)
    return figure


def _entries(mark: Mark) -> list[str]:
    """The entries of a mark in the key."""
    if isinstance(mark.key, str):
        return [mark.key] if mark.key else []
    return list(mark.key.values())


def _inches(entries: Sequence[str]) -> float:
    """The width of a key."""
    return SAMPLE + max(map(len, entries)) / LETTERS_PER_INCH if entries else 0.0


def _draw_key(collection: PlotCollection, marks: Sequence[Mark]) -> None:
    """Write the key of all marks that have entries, one below the other."""
    samples: dict[str, dict[str, Any]] = {}
    for mark in marks:
        if isinstance(mark.key, str):
            samples |= {one: _sample(mark.draw, mark.style) for one in _entries(mark)}
        else:
            keys = [key for key in collection.aes_set if key != "y"]
            for model, label in mark.key.items():
                style = collection.get_aes_kwargs(keys, "mapping", {"model": model})
                samples[label] = _sample(mark.draw, {**style, **mark.style})
    if not samples:
        return
    backend = collection.backend
    drawing = import_module(f"arviz_plots.backend.{backend}")
    styles = list(samples.values())
    if backend != "matplotlib":  # the keys of the others have lines only
        styles = [{k: v for k, v in s.items() if k != "marker" and v != "none"} for s in styles]
    if backend == "plotly":  # arviz_plots does not translate it for keys
        styles = [{"opacity" if k == "alpha" else k: v for k, v in s.items()} for s in styles]
    places: dict[str, dict[str, Any]] = {
        "matplotlib": {"frameon": False},
        "bokeh": {"margin": 0, "border_line_alpha": 0.0},
    }
    place = places.get(backend, {})
    key = drawing.legend(collection, styles, list(samples), update_visuals=False, **place)
    for i, (label, style) in enumerate(samples.items()):
        if "marker" in style and backend == "plotly":
            symbol = drawing.get_default_aes("marker", 4)[int(style["marker"][1:])]
            as_point = {"mode": "markers", "marker": {"symbol": symbol}}
            collection.viz["figure"].item().update_traces(as_point, {"name": label})
        if "marker" in style and backend == "bokeh":
            look = {key: style[key] for key in ("color", "marker")}
            point = drawing.scatter([np.nan], [np.nan], collection.iget_target(0, -1), **look)
            key.items[i].renderers = [point]


def _sample(draw: Callable[..., Any], style: Mapping[str, Any]) -> dict[str, Any]:
    """The style of an entry in the key: of points a marker, of a band a thick line."""
    if draw in (points, scatter_x):
        marker = style.get("marker", "C0")
        color = style.get("color", style.get("edgecolor"))
        return {"color": color, "marker": marker, "linestyle": "none"}
    look = {key: style[key] for key in ("color", "alpha", "width", "linestyle") if key in style}
    look.setdefault("color", "B3")  # of a mark for all models
    return {**look, "linestyle": "C0", "width": 8} if draw in (band, hspan) else look


def _space_ticks(collection: PlotCollection, in_line: int) -> None:
    """Keep numbers and dates at the axes of matplotlib apart, and write numbers in full."""
    if collection.backend != "matplotlib":
        return
    from matplotlib.dates import AutoDateFormatter, AutoDateLocator, ConciseDateFormatter
    from matplotlib.ticker import AutoLocator, MaxNLocator, ScalarFormatter

    figure = collection.viz["figure"].item()
    n_ticks = max(2, int(figure.get_figwidth() / in_line))  # as wide as an inch, as years are
    for axes in figure.axes:
        if isinstance(axes.xaxis.get_major_formatter(), AutoDateFormatter):
            locator = AutoDateLocator(maxticks=max(n_ticks, 4))
            axes.xaxis.set_major_locator(locator)
            axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))
        elif isinstance(axes.xaxis.get_major_locator(), AutoLocator):
            axes.xaxis.set_major_locator(MaxNLocator(n_ticks, steps=STEPS))
        for axis in (axes.xaxis, axes.yaxis):
            if isinstance(axis.get_major_formatter(), ScalarFormatter):
                axis.get_major_formatter().set_useOffset(False)
