"""Plots of log-evidences with their errors, by model or by estimator, and model probabilities."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object
from arviz_plots.visuals import labelled_x, line_x, scatter_x, set_xlim, set_xticks

from ..errors import ModelError
from ..evidence import Evidence
from ..system.checks import shortened
from .canvas import annotate, canvas_of_rows, format_probability, interval, linear_ticks
from .legend import add_legend, legend_style

N_TICKS = 5  # numbers of many digits beside each other

COLUMNS = ("prob", "prob_low", "prob_high", "undecided")
STYLE = {"color": "C0"}
END = 0.12  # half the length of the mark at an end of an interval


def plot_evidence(
    idata_or_table: xr.DataTree | pd.DataFrame | Mapping[str, Evidence],
    *,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> PlotCollection:
    """Plot log-evidences with one and two standard errors.

    Parameters
    ----------
    idata_or_table : pandas.DataFrame, xarray.DataTree or mapping of str to Evidence
        The table of `compare_evidence` (one row per model), the result of `estimate_evidence`, or
        a DataTree with the group ``evidence`` (one row per estimator). An estimate without standard
        error has no bar.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``: ``figure_kwargs={"figsize": (6, 3)}``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``point``, ``one_se``, ``two_se``, ``text``, ``x_label``.

    Raises
    ------
    ModelError
        If `idata_or_table` has no log-evidences.

    Examples
    --------
    >>> from pymc_statespace_filters import compare_evidence, plot_evidence
    >>> from pymc_statespace_filters.evidence import Evidence
    >>> linear = Evidence(-41.0, 0.3, "chib_jeliazkov", 2, 100, -35.0, "0c5f")
    >>> cubic = Evidence(-39.0, 0.2, "chib_jeliazkov", 3, 100, -31.0, "0c5f")
    >>> table = compare_evidence({"linear": linear, "cubic": cubic})
    >>> collection = plot_evidence(table)
    >>> collection.savefig("evidence.png")  # doctest: +SKIP
    """
    table = _table(idata_or_table)
    points = table[["log_evidence"]]
    collection = canvas_of_rows(points, backend=backend, pc_kwargs=pc_kwargs)
    for label, n_errors, width in (("two_se", 2, 1.5), ("one_se", 1, 4)):
        bars = interval(points - n_errors * table["se"], points + n_errors * table["se"])
        collection.map(line_x, label, data=bars, width=width, color="C0")
    collection.map(scatter_x, "point", color="C0")
    values = table["log_evidence"]
    texts = xr.apply_ufunc(_text, values, table["se"], vectorize=True, output_dtypes=[object])
    middle = (values.min() + values.max()).item() / 2
    collection.map(annotate, "text", texts=texts, middle=middle, color="B2")
    ends = [(values + sign * 2 * table["se"].fillna(0.0)).values for sign in (-1, 1)]
    ticks = linear_ticks(np.min(ends), np.max(ends), N_TICKS)
    collection.map(set_xticks, ignore_aes="all", store_artist=False, **ticks)
    text = "log-evidence (nats), 1 and 2 standard errors"
    collection.map(labelled_x, "x_label", ignore_aes="all", text=text)
    return collection


def _table(given: xr.DataTree | pd.DataFrame | Mapping[str, Evidence]) -> xr.Dataset:
    """Return log_evidence and se along one dimension."""
    if isinstance(given, xr.DataTree) and "evidence" in given.children:
        return given["evidence"].to_dataset()[["log_evidence", "se"]]
    if isinstance(given, Mapping) and not isinstance(given, xr.DataTree):
        of_evidence = {
            name: {"log_evidence": found.log_evidence, "se": found.se}
            for name, found in given.items()
            if isinstance(found, Evidence)
        }
        if of_evidence and len(of_evidence) == len(given):
            given = pd.DataFrame.from_dict(of_evidence, orient="index").rename_axis("estimator")
    if isinstance(given, pd.DataFrame) and {"log_evidence", "se"} <= set(given.columns):
        named = given.rename_axis(given.index.name or "model")
        return named[["log_evidence", "se"]].to_xarray()
    raise ModelError(
        "idata_or_table must be a table of compare_evidence (which takes the results of several "
        "models), a result of estimate_evidence or a DataTree with a group 'evidence', got "
        f"{shortened(given)}"
    )


def _text(log_evidence: float, se: float) -> str:
    if math.isnan(se):
        return f"{log_evidence:.2f}"
    digits = min(max(2, math.ceil(-math.log10(se))), 4) if se > 0 else 2  # none is "0.00"
    return f"{log_evidence:.{digits}f} ± {se:.{digits}f}"


def plot_model_probabilities(
    table: pd.DataFrame, *, backend: str | None = None, **pc_kwargs: Any
) -> PlotCollection:
    """Plot model probabilities with their intervals.

    An interval shows the errors of the log-evidences. Its ends are marked and written beside the
    probability, because that of precise evidences is narrower than the point.

    Parameters
    ----------
    table : pandas.DataFrame
        Result of `compare_evidence`. Undecided models have an open marker and the label
        "undecided".
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``interval``, ``ends``, ``decided``, ``undecided``, ``text``, ``x_label``.

    Raises
    ------
    ModelError
        If `table` is not such a table.

    Examples
    --------
    >>> from pymc_statespace_filters import compare_evidence, plot_model_probabilities
    >>> from pymc_statespace_filters.evidence import Evidence
    >>> linear = Evidence(-41.0, 0.3, "chib_jeliazkov", 2, 100, -35.0, "0c5f")
    >>> cubic = Evidence(-39.0, 0.2, "chib_jeliazkov", 3, 100, -31.0, "0c5f")
    >>> collection = plot_model_probabilities(
    ...     compare_evidence({"linear": linear, "cubic": cubic})
    ... )
    >>> collection.savefig("probabilities.png")  # doctest: +SKIP
    """
    if not (isinstance(table, pd.DataFrame) and set(COLUMNS) <= set(table.columns)):
        raise ModelError(f"table must be one of compare_evidence, got {shortened(table)}")
    data = table.rename_axis("model")[list(COLUMNS)].to_xarray()
    prob, undecided = data[["prob"]], data["undecided"]
    low, high = (data[[end]].rename({end: "prob"}) for end in ("prob_low", "prob_high"))

    collection = canvas_of_rows(prob, backend=backend, pc_kwargs=pc_kwargs)
    bounds = interval(low, high)
    collection.map(line_x, "interval", data=bounds, width=2, **STYLE)
    collection.map(scatter_x, "decided", data=prob.where(~undecided), **STYLE)
    collection.map(
        scatter_x,
        "undecided",
        data=prob.where(undecided),
        facecolor="B0",
        edgecolor="C0",
        width=1.5,
    )
    collection.map(ends, "ends", data=bounds, width=2, **STYLE)
    texts = xr.apply_ufunc(
        _shown_probability,
        *(data[column] for column in COLUMNS),
        vectorize=True,
        output_dtypes=[object],
    )
    collection.map(annotate, "text", texts=texts, middle=0.5, color="B2")
    collection.map(set_xlim, ignore_aes="all", limits=(-0.02, 1.02), store_artist=False)
    collection.map(labelled_x, "x_label", ignore_aes="all", text="probability of the model")
    legend = {"probability": legend_style(STYLE)}
    if bounds["prob"].notnull().any():
        legend["interval of the evidences' errors"] = {**STYLE, "width": 2}
    add_legend(collection, legend)
    return collection


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


def _shown_probability(prob: float, low: float, high: float, undecided: bool) -> str:
    """Write a probability, its interval unless that has no width, and whether it is undecided."""
    text = format_probability(prob)
    if math.isfinite(high - low) and high > low:
        digits = min(max(2, math.ceil(-math.log10(high - low)) + 1), 4)
        text, *bounds = (_with_digits(value, digits) for value in (prob, low, high))
        text = f"{text} ({' to '.join(bounds)})"
    return text + (", undecided" if undecided else "")


def _with_digits(prob: float, digits: int) -> str:
    """Write a probability with so many decimals, or more near zero and one."""
    if 1e-6 <= prob < 0.01:
        return f"{prob:.2g}"
    return f"{prob:.{digits}f}" if 0.01 <= prob < 0.99 else format_probability(prob)
