"""Plot of forecasts, or of replicated observations, beside the data."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.visuals import vline

from ..errors import ModelError
from ..former_names import former_names
from ..system.checks import check_count
from .over_time import DATA, TRUTH, over_draws, picture_over_time, points_of, spread_of
from .picture import Mark
from .results import (
    SAMPLE_DIMS,
    axis_label,
    data_of,
    functions_of,
    group_of,
    names_of,
    rows_of,
    time_label,
    transformed,
    truth_of,
    variable_of,
)
from .visual_predictive_check import picture_in_bins, pooled

PAST = 2.0  # length of the observations shown, in lengths of the forecast
MIN_PAST = 10  # observations
GROUPS = ("predictions", "free_run", "posterior_predictive")
END = {"color": "B2", "linestyle": "C1"}


@former_names
def plot_forecast(
    idata: xr.DataTree,
    *,
    group: str | None = None,
    model: pm.Model | None = None,
    var_name: str | None = None,
    records: Any = None,
    truth: Any = None,
    n_past: int | None = None,
    transform: Callable[[Any], Any] | Mapping[str, Callable[[Any], Any]] | None = None,
    errors: bool = False,
    bins: Any = None,
    corrected: bool = False,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> PlotCollection:
    """Plot predicted observations, one panel per observable.

    Bands contain 50 % and 90 % of the draws of a group, after the last observation (`forecast`) or
    beside the observations: of a free run, or of the whole new records of
    ``pm.sample_posterior_predictive``. They include the uncertainty of the parameters, the process
    noise and the observation noise, those of a forecast that of the states. A vertical line marks
    the last observation. Of a panel, each record has panels of its own. Units are taken from the
    results as in `plot_states`.

    With `bins` it is a visual predictive check of all records together: in each bin of time the
    percentiles 5, 50 and 95 of the data, and the median and 90 % band of each of these percentiles
    over replicated data sets. Of a panel with random effects, these are data of new records only
    if the random effects are drawn anew, by ``sample_vars`` of ``pm.sample_posterior_predictive``.
    Censored values count as the lowest or highest: percentiles beyond a limit are not drawn, and a
    further panel has the share of the data below the limit, if there is one limit, and that of the
    replicates.

    Parameters
    ----------
    idata : xarray.DataTree
        Result of `forecast` or of `free_run`, or draws with replicated observations.
    group : {"predictions", "free_run", "posterior_predictive", "prior_predictive"}, optional
        The group with the predicted observations; by default the first of these that is there,
        except the last.
    model : pymc.Model, optional
        The model, whose records of a panel are then called by labels that are texts, also in groups
        of PyMC. Otherwise they have numbers there, unless a variable in `idata` has the dimension
        of the records.
    var_name : str, optional
        Name of the StateSpace variable, if there are several.
    records : label or sequence of labels, optional
        The records of a panel to show; by default the first twelve.
    truth : array_like or xarray.DataArray or xarray.Dataset, optional
        The actual observations: an array of shape (number of predictions, number of observables); a
        DataArray with a dimension ``observable`` and another whose coordinate is time; or the
        result of `simulate`. Only values after the last observation are shown, or from the first
        prediction on.
    n_past : int, optional
        Number of observations before the first prediction to show; by default those in a time span
        twice as long as the forecast, and at least ten.
    transform : callable or mapping of str to callable, optional
        Function of an array, such as ``numpy.exp``, that is applied to predictions, observations
        and truth before they are drawn; or a mapping from names of observables to such functions.
    errors : bool
        Show observation minus median prediction, with the bands around zero. The observations are
        those at the times of the predictions: `truth`, and the record beside a free run.
    bins : int or sequence of numbers or dates, optional
        Number of bins with about equally many rows of the data, where rows of one time share a bin;
        or their edges, each bin with its lower edge and the last one with both. The group is then
        "posterior_predictive" or "prior_predictive", and all records are shown by default.
    corrected : bool
        In `bins`, multiply each value by the median prediction of its bin over the prediction of
        its row [1]_, so that records with different doses or covariates may be pooled. The
        prediction of a row is the median of its replicates, where the source takes a record without
        random effects. Data and predictions must be positive.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``band_90``, ``band_50`` and ``median`` (of a single time ``bar_90`` and
        ``bar_50``), ``data``, ``end``, ``truth``, ``errors``, along ``observable``. With `bins`:
        ``band_5``, ``median_5``, ``data_5`` and those of 50 and 95, and the points ``data``.

    Raises
    ------
    ModelError
        If there is no forecast, the truth or the transform does not match it, or `errors` has no
        observations; if `bins` have no data, or there is no posterior beside a replicated panel.

    Warns
    -----
    ModelWarning
        If what differs between the records of a panel is not drawn anew in `bins`.

    References
    ----------
    .. [1] M. Bergstrand, A. C. Hooker, J. E. Wallin and M. O. Karlsson (2011). Prediction-corrected
       visual predictive checks for diagnosing nonlinear mixed-effects models. *AAPS Journal* 13,
       143-151. doi:10.1208/s12248-011-9255-z

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
    groups = (group,) if group else GROUPS if bins is None else GROUPS[2:]
    group, results = group_of(idata, *groups)
    name = variable_of(predicted(results), var_name)
    labels = _labels_of_records(idata, name, model)
    rows = rows_of(idata, results, name, name, labels)
    record: xr.DataArray | None
    if bins is not None:
        given = {"truth": truth is not None, "n_past": n_past is not None, "errors": errors}
        if others := [argument for argument, is_given in given.items() if is_given]:
            raise ModelError(f"bins must be None beside {' and '.join(others)}, got {bins!r}")
        draws, record, flags = pooled(idata, group, name, rows, records, model)
    elif corrected:
        raise ModelError("corrected must be False without bins, got True")
    else:
        rows = rows.choose("records", records)
        draws = rows.over_time(results[name]).rename({results[name].dims[-1]: "observable"})
        record = data_of(idata, name, rows)
    observables = names_of(draws, "observable")
    functions = functions_of(transform, observables)
    texts = [axis_label(one, functions, draws, record) for one in observables]
    time = time_label(draws, record)
    if truth is not None:
        truth = truth_of(truth, "observations", "observable", draws, rows)
        truth = transformed(truth, "observable", functions)
    draws = transformed(draws, "observable", functions)
    record = None if record is None else transformed(record, "observable", functions)
    if record is not None and bins is not None:
        of_picture = {"x": time, "backend": backend, "pc_kwargs": pc_kwargs}
        return picture_in_bins(draws, record, flags, bins, corrected, texts, **of_picture)

    data = draws.to_dataset(name="observations")
    quantiles = over_draws(data)
    at_one_time = int(quantiles["observations"].notnull().any("quantile").sum("time").max()) == 1
    marks = []
    if errors:
        texts = [f"error of {text}" for text in texts]
        median = quantiles.sel(quantile=0.5, drop=True)
        observed = _observed_at(draws, truth, record) - median["observations"]
        quantiles = quantiles - median
        marks = [points_of(observed, "errors", DATA, "observed − median")]
    elif record is not None:
        marks = [points_of(_shown(record, draws, n_past), "data", DATA, "data")]
        marks.append(Mark(vline, "end", _end(record, draws), END, "end of record"))
    if truth is not None and not errors:
        style = {"color": TRUTH["color"]}
        marks.append(points_of(_later(truth, record, draws), "truth", style, "truth"))
    # Bands below the points, the median above them.
    below, above = spread_of(quantiles, as_bars=at_one_time)
    return picture_over_time(
        data,
        [*below, *marks, *above],
        texts,
        x=time,
        backend=backend,
        pc_kwargs=pc_kwargs,
    )


def _labels_of_records(idata: xr.DataTree, name: str, model: pm.Model | None) -> list[Any]:
    """The labels of the records of a panel, of the model or of a variable that is along them."""
    dim = f"{name}_record"
    if model is not None and dim in model.coords:
        return list(model.coords[dim])
    found = [node.coords[dim] for node in idata.children.values() if dim in node.coords]
    return list(found[0].values.tolist()) if found else []


def predicted(results: xr.Dataset) -> xr.Dataset:
    """Return the predicted observations of each variable: (chain, draw, time, observable)."""
    names = [str(name) for name in results if results[name].ndim == len(SAMPLE_DIMS) + 2]
    return results[[name for name in names if not name.endswith(("_states", "_rmse_of_draws"))]]


def _shown(record: xr.DataArray, draws: xr.DataArray, n_past: int | None) -> xr.DataArray:
    """Return the observations to show: those beside the predictions, and `n_past` before."""
    first, last = draws["time"].values[[0, -1]]
    times = record["time"].values
    n_before = int(np.sum(times < first))
    if n_past is None:
        end = min(times[-1], first)
        begin = end - PAST * (last - end)
        n_past = max(int(np.sum((times >= begin) & (times < first))), MIN_PAST)
    return record.isel(time=slice(max(n_before - n_past, 0), None))


def _end(record: xr.DataArray, draws: xr.DataArray) -> xr.Dataset:
    """Return the time of the last observation, where predictions follow."""
    kept = ("record", "observable")
    end, last = (
        array["time"].where(array.notnull()).max([dim for dim in array.dims if dim not in kept])
        for array in (record, draws)
    )
    end = end.reindex(observable=draws["observable"])
    return end.where(end < last).to_dataset(name="end")


def _later(truth: xr.DataArray, record: xr.DataArray | None, draws: xr.DataArray) -> xr.DataArray:
    """Return the actual observations from the predictions on."""
    if record is not None:
        times = truth["time"]  # numbers or dates
        is_later = (times >= draws["time"].values[0]) | (times > record["time"].values[-1])
        truth = truth.where(is_later, drop=True)
    return truth.reindex(observable=draws["observable"])


def _observed_at(
    draws: xr.DataArray, truth: xr.DataArray | None, record: xr.DataArray | None
) -> xr.DataArray:
    """Return the observations at the times of the draws: of the truth, else of the record."""
    times = draws["time"].values
    has_dates = times.dtype.kind == "M"
    unit = np.timedelta64(1, "s") if has_dates else 1.0
    observed = xr.full_like(draws.isel(chain=0, draw=0, drop=True), np.nan)
    for given in (truth, record):
        if given is not None:
            known = given.sortby("time").drop_duplicates("time")
            tolerance = 1e-6 * np.append(np.diff(times), unit).min()
            known = known.reindex(time=times, method="nearest", tolerance=tolerance)
            observed = observed.fillna(known.reindex(observable=draws["observable"]))
    if not observed.notnull().any():
        first, last = (str(t) if has_dates else f"{t:g}" for t in times[[0, -1]])
        raise ModelError(
            "errors needs observations at the times of the predictions, "
            f"{first} to {last}, got none: give them as truth"
        )
    return observed
