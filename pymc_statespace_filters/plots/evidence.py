"""Plots of log-evidences with their errors, by model or by estimator, and model probabilities."""

import math
from collections.abc import Mapping
from typing import Any

import pandas as pd
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.visuals import line_x, scatter_x

from ..errors import ModelError
from ..evidence import Evidence, compare_evidence
from ..system.checks import shortened
from .picture import Mark
from .rows import OF_PROBABILITIES, decimals, ends, format_probability, picture_of_rows
from .shapes import interval

COLUMNS = ("prob", "prob_low", "prob_high", "undecided")
STYLE = {"color": "C0"}
OPEN = {"facecolor": "B0", "edgecolor": "C0", "width": 1.5}


def plot_evidence(
    idata_or_table: xr.DataTree | pd.DataFrame | Mapping[str, Any],
    *,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> PlotCollection:
    """Plot log-evidences with one and two standard errors.

    Parameters
    ----------
    idata_or_table : pandas.DataFrame, xarray.DataTree or mapping
        The table of `compare_evidence` or what it takes (one row per model), the result of
        `estimate_evidence`, or a DataTree with the group ``evidence`` (one row per estimator). An
        estimate without standard error has no bar.
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
    bars = [
        interval(points - count * table["se"], points + count * table["se"]) for count in (2, 1)
    ]
    return picture_of_rows(
        points,
        [
            Mark(line_x, "two_se", bars[0], {"width": 1.5, **STYLE}),
            Mark(line_x, "one_se", bars[1], {"width": 4, **STYLE}),
            Mark(scatter_x, "point", points, STYLE),
        ],
        _text,
        [table["log_evidence"], table["se"]],
        x="log-evidence (nats), 1 and 2 standard errors",
        backend=backend,
        pc_kwargs=pc_kwargs,
    )


def _table(given: xr.DataTree | pd.DataFrame | Mapping[str, Any]) -> xr.Dataset:
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
        elif given and all(isinstance(one, Evidence | Mapping) for one in given.values()):
            models: dict[str, Any] = {name: given[name] for name in given}
            given = compare_evidence(models)
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
    return f"{log_evidence:.{decimals(se)}f} ± {se:.{decimals(se)}f}"


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
    bounds = interval(*(data[[end]].rename({end: "prob"}) for end in ("prob_low", "prob_high")))
    bar = {**STYLE, "width": 2}
    return picture_of_rows(
        prob,
        [
            Mark(line_x, "interval", bounds, bar, "interval of the evidences' errors"),
            Mark(scatter_x, "decided", prob.where(~undecided), STYLE, "probability"),
            Mark(scatter_x, "undecided", prob.where(undecided), OPEN, "probability"),
            Mark(ends, "ends", bounds, bar),
        ],
        _shown_probability,
        [data[column] for column in COLUMNS],
        limits=OF_PROBABILITIES,
        x="probability of the model",
        backend=backend,
        pc_kwargs=pc_kwargs,
    )


def _shown_probability(prob: float, low: float, high: float, undecided: bool) -> str:
    """Write a probability, its interval unless that has no width, and whether it is undecided."""
    text = format_probability(prob)
    if math.isfinite(high - low) and high > low:
        text, *bounds = (format_probability(p, (high - low) / 10) for p in (prob, low, high))
        text = f"{text} ({' to '.join(bounds)})"
    return text + (", undecided" if undecided else "")
