"""Plot of the innovations of a filter: over time, and against what they should not depend on."""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from arviz_base.labels import NoVarLabeller
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object
from arviz_plots.visuals import hline, labelled_title, labelled_x, labelled_y

from ..diagnostics.calibration import standardised
from ..errors import ModelError
from ..former_names import former_names
from .canvas import (
    band,
    canvas,
    few_ticks,
    interval,
    label_x,
    shorten_dates,
    time_label,
    unit_of,
    with_unit,
)
from .legend import add_legend
from .marks import bars, point_size, points, points_xy
from .panels import one_record
from .results import (
    SAMPLE_DIMS,
    data_of,
    group_of,
    rename_last_dims,
    seen_observables,
    variable_of,
)

TAIL = 1.96  # of the 95 % band of a standard normal
SEEN = {"color": "C0"}
EXPECTED = {"color": "B3", "alpha": 0.3}
ZERO = {"color": "B2", "width": 0.8}
WIDTH, WIDTH_ALONE, HEIGHT = 4.2, 7.0, 2.6  # inches of a column, of a single one, of a panel
N_TICKS = 4  # of the axis of predictions


@former_names
def plot_residuals(
    idata: xr.DataTree,
    *,
    var_name: str | None = None,
    record: Any = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> PlotCollection:
    r"""Plot the innovations of a filter: observations minus their one-step-ahead predictions.

    One column of panels per observable, with the innovations divided by their standard deviations.
    Of a right model they are white noise, independent of everything before; grey is where 95 % of
    them, or of their correlations, are expected:

    * over time;
    * their autocorrelation, within :math:`\pm 1.96 / \sqrt{J}`: what is outside is dynamics that
      the model lacks;
    * for a system with inputs, their correlation with each input so many observations earlier:
      outside, that input acts otherwise than in the model;
    * against the prediction: a curve shows a wrong restoring force or sensor law, a spread that
      grows with the amplitude shows noise that does.

    An observable without observations and an input that never changes have no panel.

    Parameters
    ----------
    idata : xarray.DataTree
        With the group ``filter_diagnostics``.
    var_name : str, optional
        Name of the StateSpace variable, if there are several.
    record : label, optional
        The record of a panel, which has a figure of its own.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``expected``, ``zero`` and ``seen`` of the variables ``innovation``,
        ``autocorrelation``, ``prediction`` and, for each input, ``input_NAME``, along
        ``observable``.

    Raises
    ------
    ModelError
        If `idata` has no such group or no observation, or `var_name` is none of its variables.

    See Also
    --------
    plot_filter_health : the calibration of the predictions, and the particles behind them.

    Examples
    --------
    >>> import numpy as np
    >>> import xarray as xr
    >>> from pymc_statespace_filters import plot_residuals
    >>> rng = np.random.default_rng(1)
    >>> dims = ("d_time", "observable")
    >>> diagnostics = xr.Dataset(
    ...     {
    ...         "d_innovation": (dims, 2.0 * rng.normal(size=(100, 1))),
    ...         "d_innovation_cov": ((*dims, "observable_2"), np.full((100, 1, 1), 4.0)),
    ...         "d_autocorrelation": (("lag", "observable"), 0.1 * rng.normal(size=(20, 1))),
    ...         "d_predicted": (("chain", "draw", *dims), rng.normal(size=(2, 50, 100, 1))),
    ...     },
    ...     coords={"d_time": np.arange(100) / 10, "lag": np.arange(1, 21), "observable": ["x"]},
    ... )
    >>> idata = xr.DataTree.from_dict({"filter_diagnostics": diagnostics})
    >>> collection = plot_residuals(idata)
    >>> collection.savefig("residuals.png")  # doctest: +SKIP
    """
    _, results = group_of(idata, "filter_diagnostics")
    if not any(str(name).endswith("_innovation") for name in results):
        raise ModelError(
            "idata's group 'filter_diagnostics' has no innovations: run "
            "psf.filter_diagnostics(idata, model) again"
        )
    name = variable_of(results, var_name, "_innovation")
    idata = one_record(idata, "filter_diagnostics", name, record)
    results, data = idata["filter_diagnostics"].to_dataset(), data_of(idata, name)
    found = _innovations(results, name, data)
    panels = _panels(results, name, found)
    n_columns = panels.sizes["observable"]
    width = WIDTH_ALONE if n_columns == 1 else WIDTH * n_columns
    collection = canvas(
        panels,
        backend=backend,
        pc_kwargs=pc_kwargs,
        aes={},
        size=(width, 0.8 + HEIGHT * len(panels)),
        n_panels=len(panels) * n_columns,
        panels_in_line=n_columns,
        cols=["__variable__", "observable"],
    )
    _draw_points(collection, panels)
    _draw_correlations(collection, panels, found.z)
    predicted = [
        f"predicted {with_unit(str(one), unit_of(one, found.z, data))}"
        for one in panels["observable"].values
    ]
    n_observables = found.z.sizes["observable"]
    _label_panels(collection, panels, predicted, time_label(found.z, data), n_observables)
    shorten_dates(collection)
    add_legend(collection, {"95 % if the model is right": {**EXPECTED, "width": 8}})
    return collection


class Innovations(NamedTuple):
    """Standardised innovations and the predictions, both over time and observable."""

    z: xr.DataArray
    predicted: xr.DataArray


def _innovations(results: xr.Dataset, name: str, record: xr.DataArray | None) -> Innovations:
    """Return standardised innovations and predictions."""
    innovation = rename_last_dims(results[f"{name}_innovation"], "time", "observable")
    cov = results[f"{name}_innovation_cov"].values
    z = innovation.copy(data=standardised(innovation.values, cov))
    if record is None:
        predicted = results[f"{name}_predicted"].mean(SAMPLE_DIMS)
        return Innovations(z, rename_last_dims(predicted, "time", "observable"))
    return Innovations(z, innovation.copy(data=record.values - innovation.values))


def _panels(results: xr.Dataset, name: str, found: Innovations) -> xr.Dataset:
    """Return what is drawn, one variable for each row of panels."""
    autocorrelation = results[f"{name}_autocorrelation"]
    rows = {
        "innovation": found.z,
        "autocorrelation": rename_last_dims(autocorrelation, "observable"),
    }
    correlation = results.get(f"{name}_input_correlation")
    if correlation is not None:
        correlation = rename_last_dims(correlation, "observable")
        for one in correlation["input"].values:
            rows[f"input_{one}"] = correlation.sel(input=one, drop=True)
    rows["prediction"] = xr.concat([found.predicted, found.z], "plot_axis").assign_coords(
        plot_axis=["x", "y"]
    )
    known = {row: values.drop_attrs() for row, values in rows.items() if values.notnull().any()}
    return xr.Dataset(known).isel(observable=seen_observables(found.z))


def _draw_points(collection: PlotCollection, panels: xr.Dataset) -> None:
    """Draw the innovations over time and against the predictions."""
    over_time, against = panels[["innovation"]], panels[["prediction"]]
    bound = xr.full_like(over_time, TAIL)
    collection.map(band, "expected", data=interval(-bound, bound), **EXPECTED)
    collection.map(strip, "expected", data=against, **EXPECTED)
    size = point_size(panels["innovation"])
    collection.map(points, "seen", data=over_time, **size, **SEEN)
    collection.map(points_xy, "seen", data=against, **size, **SEEN)
    for rows in (over_time, against):
        collection.map(hline, "zero", data=_zeros(rows), **ZERO)


def _draw_correlations(collection: PlotCollection, panels: xr.Dataset, z: xr.DataArray) -> None:
    """Draw correlations as bars over lags, with the band of as many independent pairs."""
    bound = TAIL * z.count("time") ** -0.5
    for row in set(panels) - {"innovation", "prediction"}:
        lags = panels[[row]]
        bounds = xr.ones_like(lags) * bound
        collection.map(band, "expected", data=interval(-bounds, bounds), **EXPECTED)
        collection.map(bars, "seen", data=interval(xr.zeros_like(lags), lags), width=2, **SEEN)
        collection.map(hline, "zero", data=_zeros(lags), **ZERO)


def _zeros(rows: xr.Dataset) -> xr.Dataset:
    """Return a zero for each panel."""
    others = [dim for dim in rows.dims if dim != "observable"]
    return xr.zeros_like(rows.isel(dict.fromkeys(others, 0), drop=True))


def strip(da: xr.DataArray, target: Any, **kwargs: Any) -> Any:
    """Fill the band of a standard normal along the values on the x axis."""
    x = da.sel(plot_axis="x").values
    ends = np.array([np.nanmin(x), np.nanmax(x)])
    fill = backend_from_object(target).fill_between_y
    return fill(ends, np.full(2, -TAIL), np.full(2, TAIL), target, **kwargs)


def _label_panels(
    collection: PlotCollection,
    panels: xr.Dataset,
    predicted: list[str],
    time: str,
    n_observables: int,
) -> None:
    """Label the axes of each panel, and the columns if there are several."""
    settings: dict[str, Any] = {"ignore_aes": "all", "store_artist": False}
    for row in map(str, panels):
        data = panels[[row]]
        x_label, y_label = {
            "innovation": (time, "standardised innovation"),
            "autocorrelation": ("lag (observations)", "autocorrelation"),
        }.get(row, (f"lag of {row.removeprefix('input_')} (observations)", "correlation"))
        if row == "prediction":
            y_label = "standardised innovation"
            texts = panels["observable"].copy(data=predicted)
            collection.map(label_x, data=data, texts=texts, **settings)
            collection.map(few_ticks, data=data, n_ticks=N_TICKS, **settings)
        else:
            collection.map(labelled_x, data=data, text=x_label, **settings)
        collection.map(labelled_y, data=data, text=y_label, **settings)
    if n_observables > 1:
        titles = {"labeller": NoVarLabeller(), "subset_info": True}
        titled = panels[["innovation"]]
        collection.map(labelled_title, "title", data=titled, ignore_aes="all", **titles)
