"""Probabilities of rival models, with what the errors of the evidences leave open."""

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object
from arviz_plots.visuals import labelled_x, line_x, scatter_x, set_xlim

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.plots._canvas import canvas_of_rows, interval, written

COLUMNS = ("prob", "prob_low", "prob_high", "undecided")


def plot_model_probabilities(
    table: pd.DataFrame, *, backend: str | None = None, **pc_kwargs: Any
) -> PlotCollection:
    """Draw the probabilities of rival models with their intervals.

    Parameters
    ----------
    table : pandas.DataFrame
        Of `compare_evidence`. Models among which the errors do not decide have an open mark and
        the word "undecided".
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        By default that of ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        For ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``interval``, ``decided``, ``undecided``, ``text``, ``x_label``.

    Raises
    ------
    ModelError
        If it is not such a table.

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
    collection.map(_probability, "text", undecided=undecided, color="B2")
    collection.map(set_xlim, ignore_aes="all", limits=(-0.02, 1.02), store_artist=False)
    collection.map(labelled_x, "x_label", ignore_aes="all", text="probability of the model")
    return collection


def _probability(
    da: xr.DataArray, target: Any, *, y: float, undecided: xr.DataArray, **kwargs: Any
) -> Any:
    """Write the number above its mark, towards the middle of the panel."""
    side = "right" if da.item() > 0.5 else "left"
    text = written(da.item()) + (", undecided" if undecided.item() else "")
    return backend_from_object(target).text(
        da.item(),
        np.asarray(y).item() + 0.15,
        text,
        target,
        horizontal_align=side,
        vertical_align="bottom",
        **kwargs,
    )
