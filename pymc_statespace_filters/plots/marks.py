"""Elements of plots over time: bands and bars of draws, points, paths, and functions of them."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object

from ..errors import ModelError
from .canvas import BOUND, band, canvas, curve, interval, unit_of, with_unit
from .legend import legend_style
from .results import SAMPLE_DIMS, check_names

# Blue and orange are distinguishable with colour-vision deficiency; the truth is black.
DRAWS = {"color": "C0"}
MEDIAN = {**DRAWS, "width": 1.5}
DATA = {"color": "C1"}
TRUTH = {"color": "B1", "width": 0.9}
PATHS = {"color": "C0", "alpha": 0.4, "width": 0.6}
DOTS = {"color": "C0", "alpha": 0.4, "diameter": 2}
FEW = 200  # observations that fit beside each other as separate marks
DIAMETER, LEAST_DIAMETER, LEAST_ALPHA = 4.0, 2.0, 0.6  # of points
PROBABILITIES = (90, 50)
OPACITIES = {90: 0.2, 50: 0.4}  # of bands
WIDTHS = {90: 1.0, 50: 3.5}  # of bars

Functions = Mapping[str, Callable[[Any], Any]]


def canvas_over_time(
    data: xr.Dataset,
    dim: str,
    panels_in_line: int,
    *,
    backend: str | None,
    pc_kwargs: Mapping[str, Any],
    key: Sequence[str] = (),
) -> PlotCollection:
    """Make a figure with one panel per entry of `dim`, so many beside each other."""
    n_panels = data.sizes[dim]
    n_lines = -(-n_panels // panels_in_line)
    return canvas(
        data,
        backend=backend,
        pc_kwargs=pc_kwargs,
        aes={},
        size=(7.0 if panels_in_line == 1 else 3.6 * panels_in_line, 1.3 + 2.0 * n_lines**0.9),
        n_panels=n_panels,
        panels_in_line=panels_in_line,
        key=key,
        cols=[dim],
    )


def draw_bands(collection: PlotCollection, quantiles: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Draw 50 % and 90 % bands over time; return their legend entries."""
    for prob in PROBABILITIES:
        ends = _ends(quantiles, prob)
        collection.map(band, f"band_{prob}", data=ends, alpha=OPACITIES[prob], **DRAWS)
    return {f"{prob} %": {**DRAWS, "alpha": OPACITIES[prob] + 0.1, "width": 8} for prob in (50, 90)}


def draw_median(collection: PlotCollection, quantiles: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Draw the median over time; return its legend entry."""
    collection.map(curve, "median", data=quantiles.sel(quantile=0.5, drop=True), **MEDIAN)
    return {"median": MEDIAN}


def draw_bars(collection: PlotCollection, quantiles: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Draw 50 % and 90 % bars at separate times; return their legend entries."""
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


def point_size(values: xr.DataArray) -> dict[str, Any]:
    """Return size and opacity of points over time: the more, the smaller and paler."""
    n_points = max(int(values.count("time").max()), 1)
    share = min(1.0, FEW / n_points)
    return {
        "diameter": max(DIAMETER * share**0.5, LEAST_DIAMETER),
        "alpha": max(share**0.25, LEAST_ALPHA),
        "width": 0,  # of the edge
    }


def draw_data(collection: PlotCollection, record: xr.DataArray) -> dict[str, dict[str, Any]]:
    """Draw a record as points; return its legend entry."""
    collection.map(
        points, "data", data=record.to_dataset(name="data"), **DATA, **point_size(record)
    )
    return {"data": legend_style(DATA)}


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
    x, y = np.asarray(x), np.asarray(y)
    x = np.concatenate([x, x[-1:]])  # numbers or dates; y alone breaks the line
    y = np.concatenate([y, np.full((1, y.shape[1]), np.nan)])
    return backend_from_object(target).line(x.T.ravel(), y.T.ravel(), target, **kwargs)


def points_xy(da: xr.DataArray, target: Any, *, diameter: float, **kwargs: Any) -> Any:
    """Draw points, with x and y along the dimension "plot_axis"."""
    x, y = da.stack(point=[dim for dim in da.dims if dim != "plot_axis"]).values
    return _scatter(x, y, target, diameter, **kwargs)


def _scatter(x: np.ndarray, y: np.ndarray, target: Any, diameter: float, **kwargs: Any) -> Any:
    drawing = backend_from_object(target)
    size = diameter if drawing.__name__.endswith("bokeh") else diameter**2  # other backends: area
    known = np.isfinite(x) & np.isfinite(y)
    return drawing.scatter(x[known], y[known], target, size=size, **kwargs)


def functions_of(transform: Any, names: Sequence[str], others: Sequence[str] = ()) -> Functions:
    """Return the function of each name: one function for all `names`, or a mapping.

    A mapping may name the `others` too.
    """
    if transform is None:
        return {}
    if callable(transform):
        return dict.fromkeys(names, transform)
    if isinstance(transform, Mapping) and all(callable(one) for one in transform.values()):
        check_names("transform", transform, list(dict.fromkeys([*names, *others])))
        return dict(transform)
    raise ModelError(
        "transform must be a function of an array, such as numpy.exp, or a mapping of names to "
        f"such functions, got {transform!r}"
    )


def transformed(array: xr.DataArray, along: str, functions: Functions) -> xr.DataArray:
    """Apply to each entry along the dimension `along` its function, if it has one."""
    names = [str(name) for name in array[along].values]
    if not set(names) & set(functions):
        return array
    values = np.moveaxis(array.values.astype(float), array.get_axis_num(along), 0)
    for i, name in enumerate(names):
        if name not in functions:
            continue
        result = np.asarray(functions[name](values[i]))
        if result.shape != values[i].shape:
            raise ModelError(
                "transform must return an array of the shape it is given, "
                f"{values[i].shape} of {name!r}, got shape {result.shape}"
            )
        values[i] = result
    return array.copy(data=np.moveaxis(values, 0, array.get_axis_num(along)))


def axis_label(name: str, functions: Functions, *arrays: xr.DataArray | None) -> str:
    """Return "exp(name)" if that is drawn, else the name with its unit in the `arrays`."""
    if name not in functions:
        return with_unit(name, unit_of(name, *arrays))
    of_function = getattr(functions[name], "__name__", "")
    return f"{of_function}({name})" if of_function.isidentifier() else name
