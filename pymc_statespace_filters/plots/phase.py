"""Phase portraits and restoring-force loops (thesis, Figs. 24-28)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.visuals import labelled_x, labelled_y, line_xy

from ..errors import ModelError
from ..former_names import former_names
from ..system.checks import check_count
from .canvas import canvas, unit_of, with_unit
from .legend import add_legend
from .marks import DOTS, PATHS, TRUTH, over_draws, path_xy, points_xy, thin_draws
from .panels import one_record
from .results import SAMPLE_DIMS, name_of_states, select_names, states_of, truth_of


@former_names(records="give record=, the label of one")
def plot_phase(
    idata: xr.DataTree,
    x: str | xr.DataArray,
    y: str | xr.DataArray,
    *,
    group: str | None = None,
    var_name: str | None = None,
    record: Any = None,
    truth: Any = None,
    n_draws: int = 20,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> PlotCollection:
    """Plot one quantity against another over time: a phase portrait or a restoring-force loop.

    The thin lines are draws; the thick line connects the medians of x and y. Draws of filtered
    states, and of states at observation times only, are independent over time and shown as points.

    Parameters
    ----------
    idata : xarray.DataTree
        Result of `filtered_states` or `smoothed_states`.
    x, y : str or xarray.DataArray
        Name of a state; or a quantity computed from the states, like a restoring force, with
        dimensions (chain, draw, time), whose name labels the axis.
    group : {"smoothed_states", "filtered_states"}, optional
        By default the smoothed states if there are any.
    var_name : str, optional
        Name of the StateSpace variable, if there are several.
    record : label, optional
        The record of a panel, which has a figure of its own.
    truth : xarray.DataArray, xarray.Dataset or pair of array_like, optional
        The result of `simulate` (if x and y are names of states), or the true x and y over time.
    n_draws : int
        Number of draws to show.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``draws``, ``median``, ``truth``, ``x_label``, ``y_label``.

    Raises
    ------
    ModelError
        If there are no such states, or x, y or the truth does not match them.

    Examples
    --------
    >>> import numpy as np
    >>> import xarray as xr
    >>> from pymc_statespace_filters import plot_phase
    >>> times, rng = np.linspace(0, 10, 101), np.random.default_rng(1)
    >>> circle = np.stack([np.sin(times), np.cos(times)], axis=1)
    >>> smoothed = xr.Dataset(
    ...     {"d_states": (("chain", "draw", "d_time", "state"), circle + rng.normal(
    ...         scale=0.1, size=(2, 100, 1, 2)
    ...     ) * np.ones((101, 1)))},
    ...     coords={"d_time": times, "state": ["position", "speed"]},
    ... )
    >>> idata = xr.DataTree.from_dict({"smoothed_states": smoothed})
    >>> position = smoothed["d_states"].sel(state="position", drop=True)
    >>> force = (2.0 * position + 0.5 * position**3).rename("restoring force")
    >>> portrait = plot_phase(idata, "position", "speed", truth=circle.T)
    >>> loop = plot_phase(idata, "position", force)
    >>> loop.savefig("loop.png")  # doctest: +SKIP
    """
    check_count("n_draws", n_draws, 0)
    group, name = name_of_states(idata, group, var_name)
    idata = one_record(idata, group, name, record)
    _, states, _, are_paths = states_of(idata, group, name)
    both = [_quantity("x", x, states), _quantity("y", y, states)]
    sizes = [dict(quantity.sizes) for quantity in both]
    if sizes[0] != sizes[1]:
        raise ModelError(f"y must be at the times of x and of its draws, got sizes {sizes}")
    data = _on_axes(both).to_dataset(name="phase")
    true = None if truth is None else _truth(truth, x, y, states)

    collection = canvas(data, backend=backend, pc_kwargs=pc_kwargs, aes={}, size=(6.0, 5.0))
    legend = {}
    if n_draws:
        mark, style = (path_xy, PATHS) if are_paths else (points_xy, DOTS)
        style = {**style, "alpha": 0.25}  # paler than the median
        collection.map(mark, "draws", data=thin_draws(data, n_draws), **style)
        legend["draws"] = {**PATHS, "width": 1.5}
    median = over_draws(data).sel(quantile=0.5)
    lines = {"median": ({"color": "C0", "width": 2.5}, median)}
    if true is not None:
        lines["truth"] = ({**TRUTH, "width": 1.2}, true)
    for label, (line_style, line) in lines.items():
        collection.map(line_xy, label, data=line, **line_style)
    labels = [with_unit(str(one.name), one.attrs.get("units")) for one in both]
    collection.map(labelled_x, "x_label", text=labels[0])
    collection.map(labelled_y, "y_label", text=labels[1])
    add_legend(collection, legend | {label: style for label, (style, _) in lines.items()})
    return collection


def _on_axes(both: Sequence[xr.DataArray]) -> xr.DataArray:
    """Concatenate x and y along the dimension "plot_axis", the convention of arviz_plots."""
    aligned = xr.align(*both, join="exact")
    return xr.concat([a.rename("phase") for a in aligned], "plot_axis").assign_coords(
        plot_axis=["x", "y"]
    )


def _quantity(argument: str, given: str | xr.DataArray, states: xr.DataArray) -> xr.DataArray:
    """Return a state or a computed quantity, over (chain, draw, time), with its name."""
    if isinstance(given, xr.DataArray):
        others = [dim for dim in given.dims if dim not in SAMPLE_DIMS]
        if set(given.dims) - set(others) != set(SAMPLE_DIMS) or len(others) != 1:
            raise ModelError(
                f"{argument} must have dimensions (chain, draw, time), got {given.dims}"
            )
        name = given.name or argument
        return given.rename({others[0]: "time"}).reset_coords(drop=True).rename(name)
    (state,) = select_names(argument, [given], [str(state) for state in states["state"].values])
    unit = unit_of(state, states)
    return states.sel(state=state, drop=True).rename(state).assign_attrs(units=unit)


def _truth(truth: Any, x: Any, y: Any, states: xr.DataArray) -> xr.Dataset:
    if isinstance(truth, xr.Dataset | xr.DataArray):
        if not (isinstance(x, str) and isinstance(y, str)):
            raise ModelError("truth must be a pair (x, y) if x or y is not the name of a state")
        names = [str(state) for state in states["state"].values]
        known = truth_of(truth, "states", "state", names, states["time"].values)
        true_states = [str(state) for state in known["state"].values]
        both = [known.sel(state=name) for name in select_names("truth", [x, y], true_states)]
        return _on_axes([b.drop_vars("state") for b in both]).to_dataset(name="phase")
    pair = [np.asarray(values, dtype=float) for values in truth]
    if len(pair) != 2 or pair[0].ndim != 1 or pair[0].shape != pair[1].shape:
        raise ModelError(
            "truth must be two arrays of one length, the true x and y, got shapes "
            f"{[p.shape for p in pair]}"
        )
    return xr.Dataset({"phase": (("plot_axis", "time"), pair)}, coords={"plot_axis": ["x", "y"]})
