"""Plot of model probabilities with their intervals."""

from typing import Any

import pandas as pd
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.visuals import labelled_x, line_x, scatter_x, set_xlim

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.plots.canvas import (
    annotate,
    canvas_of_rows,
    format_probability,
    interval,
)

COLUMNS = ("prob", "prob_low", "prob_high", "undecided")


def plot_model_probabilities(
    table: pd.DataFrame, *, backend: str | None = None, **pc_kwargs: Any
) -> PlotCollection:
    """Plot model probabilities with their intervals.

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
        Visuals ``interval``, ``decided``, ``undecided``, ``text``, ``x_label``.

    Raises
    ------
    ModelError
        If `table` is not such a table.

    Examples
    --------
    >>> from pymc_statespace_filters import Evidence, compare_evidence, plot_model_probabilities
    >>> linear = Evidence(-41.0, 0.3, "chib_jeliazkov", 2, 100, -35.0, "0c5f")
    >>> cubic = Evidence(-39.0, 0.2, "chib_jeliazkov", 3, 100, -31.0, "0c5f")
    >>> collection = plot_model_probabilities(
    ...     compare_evidence({"linear": linear, "cubic": cubic})
    ... )
    >>> collection.savefig("probabilities.png")  # doctest: +SKIP
    """
    if not (isinstance(table, pd.DataFrame) and set(COLUMNS) <= set(table.columns)):
        raise ModelError(f"table must be one of compare_evidence, got {table!r}")
    data = table.rename_axis("model")[list(COLUMNS)].to_xarray()
    prob, undecided = data[["prob"]], data["undecided"]
    low, high = (data[[end]].rename({end: "prob"}) for end in ("prob_low", "prob_high"))

    collection = canvas_of_rows(prob, backend=backend, pc_kwargs=pc_kwargs)
    collection.map(line_x, "interval", data=interval(low, high), width=2, color="C0")
    collection.map(scatter_x, "decided", data=prob.where(~undecided), color="C0")
    collection.map(
        scatter_x,
        "undecided",
        data=prob.where(undecided),
        facecolor="B0",
        edgecolor="C0",
        width=1.5,
    )
    texts = xr.apply_ufunc(_text, data["prob"], undecided, vectorize=True, output_dtypes=[object])
    collection.map(annotate, "text", texts=texts, middle=0.5, color="B2")
    collection.map(set_xlim, ignore_aes="all", limits=(-0.02, 1.02), store_artist=False)
    collection.map(labelled_x, "x_label", ignore_aes="all", text="probability of the model")
    return collection


def _text(prob: float, undecided: bool) -> str:
    return format_probability(prob) + (", undecided" if undecided else "")
