"""Legend above the panels, in as many lines as its width needs."""

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np
from arviz_plots import PlotCollection

DOTS_PER_INCH = 100
# Width in dots of a letter, and of the sample line with the gaps of an entry.
LETTER = {"matplotlib": 7.5, "bokeh": 6.2}
TITLE, MARGINS = 30.0, 150.0  # heights in dots, of plotly
SAMPLE = {"matplotlib": 65.0, "bokeh": 34.0}


def legend_style(style: Mapping[str, Any]) -> dict[str, Any]:
    """Return the legend style of points: a dotted line, as legends show lines only."""
    return {**style, "linestyle": "C2", "width": 4}


def add_legend(
    collection: PlotCollection, entries: Mapping[str, Mapping[str, Any]], titled: bool = False
) -> None:
    """Write a legend above the panels, and above their titles if they are `titled`."""
    backend, labels = collection.backend, list(entries)
    in_line = len(labels)
    if backend in LETTER:
        in_line = _entries_in_line(labels, backend, _width(collection))
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
    drawing = import_module(f"arviz_plots.backend.{backend}")
    drawing.legend(collection, styles, labels, update_visuals=False, **places[backend])


def _width(collection: PlotCollection) -> float:
    """Return the room for the legend in dots: the figure's width, or that of a panel of bokeh."""
    if collection.backend == "bokeh":
        return float(collection.iget_target(0, -1).width)
    return float(DOTS_PER_INCH * collection.viz["figure"].item().get_size_inches()[0])


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
