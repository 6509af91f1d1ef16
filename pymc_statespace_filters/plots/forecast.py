"""Plot of forecasts beside the observations."""

from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.visuals import vline

from pymc_statespace_filters.plots.marks import (
    DATA,
    TRUTH,
    add_legend,
    canvas_over_time,
    draw_bands,
    draw_bars,
    label_axes,
    legend_style,
    points,
)
from pymc_statespace_filters.plots.results import (
    data_of,
    group_of,
    rename_last_dims,
    truth_of,
    variable_of,
)
from pymc_statespace_filters.system.checks import check_count

PAST = 2.0  # length of the observations shown, in lengths of the forecast
MIN_PAST = 10  # observations


def plot_forecast(
    idata: xr.DataTree,
    *,
    var_name: str | None = None,
    truth: Any = None,
    n_past: int | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> PlotCollection:
    """Plot predicted observations after the last observation, one panel per observable.

    Bands contain 50 % and 90 % of the draws, which include the uncertainty of parameters and
    states, the process noise and the observation noise. A vertical line marks the last observation.

    Parameters
    ----------
    idata : xarray.DataTree
        Result of `forecast`.
    var_name : str, optional
        Name of the StateSpace variable, if there are several.
    truth : array_like or xarray.DataArray or xarray.Dataset, optional
        The actual observations: an array of shape (number of predictions, number of observables); a
        DataArray with a dimension ``observable`` and another whose coordinate is time; or the
        result of `simulate`. Only values after the last observation are shown.
    n_past : int, optional
        Number of past observations to show; by default those in a time span twice as long as the
        forecast, and at least ten.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``band_90``, ``band_50`` and ``median`` (of a single time ``bar_90`` and
        ``bar_50``), ``data``, ``end``, ``truth``, along ``observable``.

    Raises
    ------
    ModelError
        If there is no forecast, or the truth does not match it.

    Examples
    --------
    >>> import numpy as np
    >>> import xarray as xr
    >>> from pymc_statespace_filters import plot_forecast
    >>> times, rng = np.arange(150) / 10, np.random.default_rng(1)
    >>> observed = np.sin(times) + 0.1 * rng.normal(size=150)
    >>> drawn = np.sin(times[100:])[:, None] + 0.1 * rng.normal(size=(2, 100, 50, 1))
    >>> observable = {"observable": ["position"]}
    >>> predictions = xr.Dataset(
    ...     {"d": (("chain", "draw", "d_time", "observable"), drawn)},
    ...     coords={"d_time": times[100:], **observable},
    ... )
    >>> record = xr.Dataset(
    ...     {"d": (("d_time", "observable"), observed[:100, None])},
    ...     coords={"d_time": times[:100], **observable},
    ... )
    >>> idata = xr.DataTree.from_dict({"predictions": predictions, "observed_data": record})
    >>> collection = plot_forecast(idata, truth=observed[100:])
    >>> collection.savefig("forecast.png")  # doctest: +SKIP
    """
    if n_past is not None:
        check_count("n_past", n_past, 0)
    _, results = group_of(idata, "predictions")
    predicted = results[[name for name in results if not str(name).endswith("_states")]]
    name = variable_of(predicted, var_name)
    draws = rename_last_dims(predicted[name], "time", "observable")
    observables = [str(observable) for observable in draws["observable"].values]
    if truth is not None:
        truth = truth_of(truth, "observations", "observable", observables, draws["time"].values)
    record = data_of(idata, name)

    data = draws.to_dataset(name="observations")
    collection = canvas_over_time(data, "observable", backend=backend, pc_kwargs=pc_kwargs)
    legend = (draw_bars if data.sizes["time"] == 1 else draw_bands)(collection, data)
    if record is not None:
        past = record.tail(time=_n_past(record, draws) if n_past is None else n_past)
        end = record["time"][-1].expand_dims(observable=observables).drop_vars("time")
        if truth is not None:
            truth = truth.where(truth["time"] > record["time"][-1], drop=True)
        collection.map(vline, "end", data=end.to_dataset(name="end"), color="B2", linestyle="C1")
        collection.map(points, "data", data=past.to_dataset(name="data"), diameter=4, **DATA)
        legend["data"] = legend_style(DATA)
        legend["end of record"] = {"color": "B2", "linestyle": "C1"}
    if truth is not None:
        actual = truth.reindex(observable=observables).to_dataset(name="truth")
        collection.map(points, "truth", data=actual, diameter=4, color=TRUTH["color"])
        legend["truth"] = legend_style(TRUTH)
    label_axes(collection, draws["time"])
    add_legend(collection, legend)
    return collection


def _n_past(record: xr.DataArray, draws: xr.DataArray) -> int:
    """Return the number of observations in a time span `PAST` times that of the forecast."""
    end = record["time"].values[-1]
    begin = end - PAST * (draws["time"].values[-1] - end)
    return max(int(np.sum(record["time"].values >= begin)), MIN_PAST)
