"""One labelled row for each entry, with its point, intervals and number."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object
from arviz_plots.visuals import set_xlim

from .picture import LETTERS_PER_INCH, LONGEST_NAME, Mark, picture

WIDTH, HEIGHT = 6.4, 0.6  # inches, of the panel and of a row in it
OF_PROBABILITIES = -0.02, 1.02  # limits of an axis
END = 0.12  # half the length of the mark at an end of an interval


def picture_of_rows(
    points: xr.Dataset,
    marks: Sequence[Mark],
    text: Callable[..., str],
    columns: Sequence[xr.DataArray],
    *,
    limits: tuple[float, float] | None = None,
    x: str,
    backend: str | None,
    pc_kwargs: Mapping[str, Any],
) -> PlotCollection:
    """Draw marks in the row of each entry of the only dimension, the first on top.

    The ``text`` of the values of ``columns`` stands above a point, towards the middle of the axis,
    whose ``limits`` are by default those of what is drawn.
    """
    (dim,), (values,) = map(str, points.dims), points.values()
    places = np.arange(points.sizes[dim])[::-1]
    names = [str(name) for name in points[dim].values]
    for_names = max(0, max(map(len, names), default=0) - LONGEST_NAME) / LETTERS_PER_INCH
    rows = {"places": places, "names": names}
    texts = xr.apply_ufunc(text, *columns, vectorize=True, output_dtypes=[object])
    ends_of_axis = limits or (values.min().item(), values.max().item())
    beside = {"texts": texts, "middle": np.mean(ends_of_axis), "color": "B2"}
    fixed = [] if limits is None else [Mark(set_xlim, None, points, {"limits": limits})]
    return picture(
        points,
        [
            Mark(label_rows, None, points, rows),
            *marks,
            Mark(annotate, "text", points, beside),
            *fixed,
        ],
        x=x,
        y="",
        size=(WIDTH + for_names, 0.2 + HEIGHT * len(places)),
        backend=backend,
        pc_kwargs=pc_kwargs,
        aesthetics={"aes": {"y": [dim]}, "y": places},
    )


def label_rows(da: xr.DataArray, target: Any, *, places: np.ndarray, names: list[str]) -> None:
    """Label the rows at the y axis, with space above and below."""
    drawing = backend_from_object(target)
    drawing.ylim((-0.5, len(names) - 0.3), target)
    drawing.yticks(places, names, target)


def annotate(
    da: xr.DataArray, target: Any, *, y: Any, texts: xr.DataArray, middle: float, **kwargs: Any
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


def ends(da: xr.DataArray, target: Any, *, y: Any, **kwargs: Any) -> Any:
    """Mark the ends of an interval by vertical lines that are longer than a point."""
    row = np.asarray(y).item()
    low, high = da.values
    return backend_from_object(target).line(
        [low, low, np.nan, high, high],
        [row - END, row + END, np.nan, row - END, row + END],
        target,
        **kwargs,
    )


def decimals(error: float) -> int:
    """Decimals that show an error, from two to four; two without one."""
    known = 0 < error < math.inf
    return min(max(2, math.ceil(-math.log10(error))), 4) if known else 2


def format_probability(prob: float, error: float = 0.0) -> str:
    """Format a probability with digits for its error, and enough near zero and near one."""
    if prob < 1e-6:
        return "< 1e-6"
    if prob < 0.01:
        return f"{prob:.{2 if error else 1}g}"
    return f"{prob:.{decimals(error)}f}" if prob < 0.99 else f"{prob:.4f}"
