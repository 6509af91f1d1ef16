"""Elements of plots over time: bands and bars of draws, points, paths, legend and axis labels."""

from collections.abc import Hashable, Mapping
from importlib import import_module
from typing import Any

import numpy as np
import xarray as xr
from arviz_base.labels import NoVarLabeller
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object
from arviz_plots.visuals import labelled_x, labelled_y

from pymc_statespace_filters.plots.canvas import BOUND, band, canvas, curve, interval
from pymc_statespace_filters.plots.results import SAMPLE_DIMS

# Blue and orange are distinguishable with colour-vision deficiency; the truth is black.
DRAWS = {"color": "C0"}
DATA = {"color": "C1"}
TRUTH = {"color": "B1", "width": 0.9}
PATHS = {"color": "C0", "alpha": 0.4, "width": 0.6}
DOTS = {"color": "C0", "alpha": 0.4, "diameter": 2}
MAX_IN_LINE = 5  # legend entries
PROBABILITIES = (90, 50)
OPACITIES = {90: 0.2, 50: 0.4}  # of bands
WIDTHS = {90: 1.0, 50: 3.5}  # of bars


def canvas_over_time(
    data: xr.Dataset, dim: str, *, backend: str | None, pc_kwargs: Mapping[str, Any]
) -> PlotCollection:
    """Make a figure with one panel per entry of `dim`, below each other."""
    n_panels = data.sizes[dim]
    return canvas(
        data,
        backend=backend,
        pc_kwargs=pc_kwargs,
        aes={},
        size=(7.0, 1.3 + 2.0 * n_panels**0.9),
        n_panels=n_panels,
        panels_in_line=1,
        cols=[dim],
    )


def draw_bands(collection: PlotCollection, draws: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Draw median, 50 % and 90 % bands of draws over time; return their legend entries."""
    quantiles = over_draws(draws)
    for prob in PROBABILITIES:
        ends = _ends(quantiles, prob)
        collection.map(band, f"band_{prob}", data=ends, alpha=OPACITIES[prob], **DRAWS)
    median = quantiles.sel(quantile=0.5, drop=True)
    collection.map(curve, "median", data=median, width=1.5, **DRAWS)
    bands = {
        f"{prob} %": {**DRAWS, "alpha": OPACITIES[prob] + 0.1, "width": 8} for prob in (50, 90)
    }
    return {"median": {**DRAWS, "width": 1.5}, **bands}


def draw_bars(collection: PlotCollection, draws: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Draw 50 % and 90 % bars of draws at separate times; return their legend entries."""
    quantiles = over_draws(draws)
    for prob in PROBABILITIES:
        ends = _ends(quantiles, prob)
        collection.map(bars, f"bar_{prob}", data=ends, width=WIDTHS[prob], **DRAWS)
    return {f"{prob} %": {**DRAWS, "width": WIDTHS[prob]} for prob in (50, 90)}


def over_draws(draws: xr.Dataset) -> xr.Dataset:
    """Return quantiles over the draws that are not NaN; NaN where all are."""
    known = draws.notnull().any(SAMPLE_DIMS)
    tails = [(1 - prob / 100) / 2 for prob in PROBABILITIES]
    levels = [*tails, 0.5, *(1 - tail for tail in tails[::-1])]
    return draws.where(known, 0.0).quantile(levels, SAMPLE_DIMS).where(known)


def _ends(quantiles: xr.Dataset, prob: int) -> xr.Dataset:
    tail = (1 - prob / 100) / 2
    return interval(
        *(
            quantiles.sel(quantile=level, method="nearest").drop_vars("quantile")
            for level in (tail, 1 - tail)
        )
    )


def thin_draws(draws: xr.Dataset, n_draws: int) -> xr.Dataset:
    """Return `n_draws` of the draws that are not all NaN, evenly, along the dimension "path"."""
    stacked = draws.stack(path=SAMPLE_DIMS).drop_vars(["path", *SAMPLE_DIMS])
    stacked = stacked.dropna("path", how="all")
    n_draws = min(n_draws, stacked.sizes["path"])
    return stacked.isel(path=np.linspace(0, stacked.sizes["path"] - 1, n_draws).astype(int))


def bars(da: xr.DataArray, target: Any, **kwargs: Any) -> Any:
    """Draw a vertical line between the bounds at each time."""
    dim = _dim_of(da, BOUND)
    low, high = da.transpose(BOUND, dim).values
    return _broken_line([da[dim].values] * 2, [low, high], target, **kwargs)


def points(da: xr.DataArray, target: Any, *, diameter: float, **kwargs: Any) -> Any:
    """Draw values over time as points, those of all paths if there is a dimension "path"."""
    dim = _dim_of(da, "path")
    times, values = xr.broadcast(da[dim], da)
    return _scatter(times.values.ravel(), values.values.ravel(), target, diameter, **kwargs)


def paths(da: xr.DataArray, target: Any, **kwargs: Any) -> Any:
    """Draw each path as a line over time."""
    dim = _dim_of(da, "path")
    values = da.transpose(dim, "path").values
    return _broken_line(
        [[time] * values.shape[1] for time in da[dim].values], values, target, **kwargs
    )


def _dim_of(da: xr.DataArray, *others: str) -> Hashable:
    (dim,) = (dim for dim in da.dims if dim not in others)
    return dim


def _broken_line(x: Any, y: Any, target: Any, **kwargs: Any) -> Any:
    """Draw the columns of y against those of x as one line with gaps."""
    gaps = np.full((1, np.shape(x)[1]), np.nan)
    x, y = (np.concatenate([values, gaps]).T.ravel() for values in (x, y))
    return backend_from_object(target).line(x, y, target, **kwargs)


def path_xy(da: xr.DataArray, target: Any, **kwargs: Any) -> Any:
    """Draw each path as a line, with x and y along the dimension "plot_axis"."""
    dim = _dim_of(da, "path", "plot_axis")
    x, y = da.transpose("plot_axis", dim, "path").values
    return _broken_line(x, y, target, **kwargs)


def points_xy(da: xr.DataArray, target: Any, *, diameter: float, **kwargs: Any) -> Any:
    """Draw points, with x and y along the dimension "plot_axis"."""
    x, y = da.stack(point=[dim for dim in da.dims if dim != "plot_axis"]).values
    return _scatter(x, y, target, diameter, **kwargs)


def _scatter(x: np.ndarray, y: np.ndarray, target: Any, diameter: float, **kwargs: Any) -> Any:
    drawing = backend_from_object(target)
    size = diameter if drawing.__name__.endswith("bokeh") else diameter**2  # other backends: area
    known = np.isfinite(x) & np.isfinite(y)
    return drawing.scatter(x[known], y[known], target, size=size, **kwargs)


def legend_style(style: Mapping[str, Any]) -> dict[str, Any]:
    """Return the legend style of points: a dotted line, as legends show lines only."""
    return {**style, "linestyle": "C2", "width": 4}


def add_legend(
    collection: PlotCollection, entries: Mapping[str, Mapping[str, Any]], n_columns: int = 1
) -> None:
    """Write a legend above the panels, which form `n_columns` columns."""
    in_line = -(-len(entries) // (1 + (len(entries) > MAX_IN_LINE)))  # a long one in two lines
    places: dict[str, dict[str, Any]] = {
        "matplotlib": {"loc": "outside upper center", "frameon": False, "ncols": in_line},
        "plotly": {
            "legend_orientation": "h",
            "legend_y": 1.02,
            "legend_yanchor": "bottom",
            "legend_traceorder": "normal",
            "margin": {"t": 60, "b": 60, "r": 30},
        },
        "bokeh": {  # above the first panel, and no wider than it
            "side": "above",
            "border_line_alpha": 0.0,
            "margin": 0,
            "padding": 0,
            "ncols": in_line if n_columns == 1 else 3,
            "label_text_font_size": "12px" if n_columns == 1 else "10px",
            "glyph_width": 20 if n_columns == 1 else 12,
        },
        "none": {},
    }
    drawing = import_module(f"arviz_plots.backend.{collection.backend}")
    # arviz_plots does not translate "alpha" for legends.
    alpha = "opacity" if collection.backend == "plotly" else "alpha"
    styles = [{alpha if k == "alpha" else k: v for k, v in s.items()} for s in entries.values()]
    drawing.legend(
        collection, styles, list(entries), update_visuals=False, **places[collection.backend]
    )


def label_axes(collection: PlotCollection, time: xr.DataArray) -> None:
    """Label the y axis of each panel, and the time axis below the lowest panels."""
    collection.map(
        labelled_y, "y_label", ignore_aes="all", subset_info=True, labeller=NoVarLabeller()
    )
    (dim,) = collection.viz["plot"].dims
    n_columns = int(collection.viz["col_index"].max()) + 1
    lowest = collection.data.isel({dim: slice(-n_columns, None)})
    settings = {"ignore_aes": "all", "store_artist": False}
    collection.map(labelled_x, data=lowest, text=time_label(time), **settings)


def time_label(time: xr.DataArray) -> str:
    """Return the label of the time axis, with the unit from the attributes if there is one."""
    return f"time ({time.attrs['units']})" if "units" in time.attrs else "time"
