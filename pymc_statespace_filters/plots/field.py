"""Plot of a field of one or two states, from `field`."""

import math
from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object
from arviz_plots.visuals import hline

from ..errors import ModelError
from .picture import Mark, picture
from .shapes import ZERO, band, bars, curve, interval, points

MEAN = {"color": "C0", "width": 1.5}
BAND = {"color": "C0", "alpha": 0.3}
RUG = {"color": "C1", "width": 0.8, "alpha": 0.5}
VISITED = {"color": "C1", "diameter": 2.0, "alpha": 0.8, "width": 0, "marker": "C0"}
SIZE, SIZE_OF_MAP = (6.0, 3.2), (4.0, 3.4)  # inches of a panel
MOST_VISITS = 500
HEIGHT = 0.04  # of the rug, as a share of the panel
N_LEVELS = 8  # of a map, about
NEEDED = {"mean", "sd", "low", "high", "visited"}


def plot_field(
    found: xr.DataTree, *, name: str | None = None, backend: str | None = None, **pc_kwargs: Any
) -> PlotCollection:
    """Plot a field of one state as a curve, of two states as maps of its mean and its sd.

    The curve has its band, and marks at the visited states along the lower edge; maps have them as
    points. Where there are none, the prior makes the field.

    Parameters
    ----------
    found : xarray.DataTree
        The result of `field`. Of a field of three states choose a slice, one of its states at a
        single value.
    name : str, optional
        The vector of coefficients, needed if there are several.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``zero``, ``band``, ``mean`` and ``visited``; of maps ``map`` and ``visited``.

    Raises
    ------
    ModelError
        If `found` is something else, has no such name, or a field of more than two states.

    Examples
    --------
    >>> import numpy as np
    >>> import xarray as xr
    >>> from pymc_statespace_filters import plot_field
    >>> z = np.linspace(-1, 1, 21)
    >>> field = xr.Dataset(
    ...     {
    ...         "mean": ("z", -(z**3)), "sd": ("z", 0.1 + z**2),
    ...         "low": ("z", -(z**3) - 0.2 - 2 * z**2), "high": ("z", -(z**3) + 0.2 + 2 * z**2),
    ...         "visited": (("visit", "visited_state"), [[-0.3], [0.1], [0.5]]),
    ...     },
    ...     coords={"z": z, "visited_state": ["z"]},
    ...     attrs={"ci_prob": 0.9},
    ... )
    >>> collection = plot_field(xr.DataTree.from_dict({"c": field}))
    >>> collection.savefig("field.png")  # doctest: +SKIP
    """
    name, data = _chosen(found, name)
    states = [str(dim) for dim in data["mean"].dims]
    visited = data["visited"].sel(visited_state=states)
    some = np.linspace(0, len(visited) - 1, min(MOST_VISITS, len(visited))).astype(int)
    visited = visited[some].drop_vars("visited_state")
    given = {"backend": backend, "pc_kwargs": pc_kwargs}
    if len(states) == 1:
        return _curve(name, data, visited.values[:, 0], given)
    return _maps(name, data, visited, given)


def _chosen(found: Any, name: str | None) -> tuple[str, xr.Dataset]:
    """The field of this name, or the only one, without states at a single value."""
    is_tree = isinstance(found, xr.DataTree)
    fields = (
        [key for key in found.children if set(found[key].data_vars) >= NEEDED] if is_tree else []
    )
    if not fields:
        raise ModelError(f"found must be the result of field, got {type(found).__name__}")
    if name is None and len(fields) == 1:
        name = fields[0]
    if name not in fields:
        raise ModelError(f"name must be one of the fields {fields}, got {name!r}")
    data = found[name].to_dataset()
    single = [dim for dim in data["mean"].dims if data.sizes[dim] == 1]
    data = data.squeeze(single, drop=True)
    if not 1 <= data["mean"].ndim <= 2:
        raise ModelError(
            f"the field {name!r} must have one or two states with several values, got "
            f"{dict(data['mean'].sizes)}: choose them by at= of psf.field"
        )
    return str(name), data


def _curve(name: str, data: xr.Dataset, visited: Any, given: dict[str, Any]) -> PlotCollection:
    mean = data[["mean"]]
    ends = interval(*(data[[end]].rename({end: "mean"}) for end in ("low", "high")))
    lowest, highest = float(data["low"].min()), float(data["high"].max())
    top = np.full(len(visited), lowest)
    ticks = np.stack([top - HEIGHT * (highest - lowest), top])
    rug = xr.Dataset({"mean": (("ci_bound", "visit"), ticks)}, coords={"visit": visited})
    return picture(
        mean,
        [
            Mark(hline, "zero", xr.Dataset({"mean": 0.0}), ZERO),
            Mark(band, "band", ends, BAND, f"{100 * data.attrs['ci_prob']:g} %"),
            Mark(curve, "mean", mean, MEAN, "mean"),
            Mark(bars, "visited", rug, RUG, "visited states"),
        ],
        x=str(mean["mean"].dims[0]),
        y=f"field of {name}",
        size=SIZE,
        **given,
    )


def _maps(
    name: str, data: xr.Dataset, visited: xr.DataArray, given: dict[str, Any]
) -> PlotCollection:
    panels = data[["mean", "sd"]]
    at = visited.rename(visited_state="plot_axis").assign_coords(plot_axis=["x", "y"])
    x, y = map(str, panels["mean"].dims)
    return picture(
        panels,
        [
            Mark(shades, "map", panels),
            Mark(points, "visited", xr.Dataset({"mean": at, "sd": at}), VISITED, "visited states"),
        ],
        x=x,
        y=y,
        title={key: f"{key} of the field of {name}: {_scale(panels[key])}" for key in panels},
        cols=["__variable__"],
        size=SIZE_OF_MAP,
        in_line=2,
        **given,
    )


def shades(da: xr.DataArray, target: Any) -> Any:
    """Draw values over two states by colours, the higher the brighter."""
    x, y = da.dims
    fill = backend_from_object(target).contourf
    return fill(da[x].values, da[y].values, da.values, target, levels=_levels(da), cmap="viridis")


def _levels(da: xr.DataArray) -> np.ndarray:
    """Round numbers from below the lowest value to above the highest."""
    low, high = float(da.min()), float(da.max())
    rough = max((high - low) / N_LEVELS, abs(high) * 1e-6, 1e-300)
    decade = 10.0 ** math.floor(math.log10(rough))
    step = next(digit * decade for digit in (1, 2, 5, 10) if digit * decade >= rough * (1 - 1e-9))
    return step * np.arange(
        math.floor(low / step), max(math.ceil(high / step), math.floor(low / step) + 1) + 1
    )


def _scale(da: xr.DataArray) -> str:
    levels = _levels(da)
    return f"{levels[0]:g} (dark) to {levels[-1]:g} (bright), by {levels[1] - levels[0]:g}"
