"""Legends above the panels, of lines and points, for every backend."""

import math
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np
from arviz_plots import PlotCollection

DOTS_PER_INCH = 100
# Width in dots of a letter, and of the sample line with the gaps of an entry; of matplotlib with
# letters of ten points.
LETTER = {"matplotlib": 7.5, "bokeh": 6.2}
SAMPLE = {"matplotlib": 70.0, "bokeh": 34.0}
LINE = 0.21  # inches, of entries beside each other
TITLE, MARGINS = 30.0, 150.0  # heights in dots, of plotly


def legend_style(style: Mapping[str, Any]) -> dict[str, Any]:
    """Return the legend style of points: a marker without a line."""
    return {"marker": "C0", **style, "linestyle": "none"}


def add_legend(collection: PlotCollection, entries: Mapping[str, Mapping[str, Any]]) -> None:
    """Write a legend above the panels and their titles."""
    backend, labels = collection.backend, list(entries)
    in_line = len(labels)
    if backend in LETTER:
        in_line = _entries_in_line(labels, backend, _width(collection))
    titled = {"title", "failures"} & set(collection.viz.children)
    places: dict[str, dict[str, Any]] = {
        "matplotlib": {"loc": "outside upper center", "frameon": False, "ncols": in_line},
        "plotly": {  # which breaks the line itself
            "legend_orientation": "h",
            "legend_y": 1.02 if not titled else 1.0 + TITLE / _height(collection),
            "legend_yanchor": "bottom",
            "legend_traceorder": "normal",
            "margin": {"t": 60 + (TITLE if titled else 0), "b": 60, "r": 30},
        },
        "bokeh": {  # above one panel, and no wider than it
            "side": "above",
            "border_line_alpha": 0.0,
            "margin": 0,
            "padding": 0,
            "ncols": in_line,
            "label_text_font_size": "11px",
            "glyph_width": 18,
        },
        "none": {},
    }
    # arviz_plots does not translate "alpha" for legends.
    alpha = "opacity" if backend == "plotly" else "alpha"
    styles = [{alpha if k == "alpha" else k: v for k, v in s.items()} for s in entries.values()]
    if backend != "matplotlib":  # the others have lines only
        styles = [s if "marker" not in s else {"color": s["color"]} for s in styles]
    drawing = import_module(f"arviz_plots.backend.{backend}")
    key = drawing.legend(collection, styles, labels, update_visuals=False, **places[backend])
    for i, (label, style) in enumerate(entries.items()):
        if "marker" in style:
            _show_marker(collection, key, i, label, style)


def _show_marker(
    collection: PlotCollection, key: Any, i: int, label: str, style: Mapping[str, Any]
) -> None:
    """Replace the line of an entry by a marker, where the backend's legends have lines only."""
    drawing = import_module(f"arviz_plots.backend.{collection.backend}")
    if collection.backend == "plotly":
        symbol = drawing.get_default_aes("marker", 4)[int(style["marker"][1:])]
        (entry,) = collection.viz["figure"].item().select_traces({"name": label})
        entry.update(mode="markers", marker={"symbol": symbol})
    if collection.backend == "bokeh":
        look = {name: style[name] for name in ("color", "marker")}
        point = drawing.scatter([np.nan], [np.nan], collection.iget_target(0, -1), **look)
        key.items[i].renderers = [point]


def further_lines(labels: Sequence[str], width: float) -> float:
    """Return the height in inches of what does not fit into the first line of a legend."""
    in_line = _entries_in_line(labels, "matplotlib", DOTS_PER_INCH * width)
    return LINE * max(0, math.ceil(len(labels) / in_line) - 1)


def _width(collection: PlotCollection) -> float:
    """Return the room for the legend in dots: the figure's width, or that of a panel of bokeh.

    That of matplotlib is relative to its letters, whose size is a matter of style.
    """
    if collection.backend == "bokeh":
        return float(collection.iget_target(0, -1).width)
    matplotlib = import_module("matplotlib")
    size = import_module("matplotlib.font_manager").FontProperties(
        size=matplotlib.rcParams["legend.fontsize"]
    )
    inches = collection.viz["figure"].item().get_size_inches()[0]
    return float(DOTS_PER_INCH * inches * 10.0 / size.get_size_in_points())


def _height(collection: PlotCollection) -> float:
    """Return the height of the panels of a plotly figure in dots."""
    if collection.backend != "plotly":
        return DOTS_PER_INCH
    height = collection.viz["figure"].item().layout.height
    return float(max((height or 450) - MARGINS, DOTS_PER_INCH))


def _entries_in_line(labels: Sequence[str], backend: str, width: float) -> int:
    """Return the largest number of legend columns that fit into `width` dots."""
    lengths = [len(label) for label in labels]
    for n_columns in range(len(labels), 1, -1):
        widest = [max(column) for column in np.array_split(lengths, n_columns)]
        if sum(LETTER[backend] * n + SAMPLE[backend] for n in widest) <= width:
            return n_columns
    return 1
