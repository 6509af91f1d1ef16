"""Plot of model probabilities against the correction's exponent and the width of priors."""

from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.visuals import labelled_x, labelled_y, set_xticks, set_ylim

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence import prior_sensitivity
from pymc_statespace_filters.plots.canvas import band, canvas, curve, interval, logarithmic_ticks

LABELS = {
    "prob": "exponent α of the correction",
    "width_prob": "width of the priors (factor)",
}
LABEL_WIDTH = 44  # characters, of a line below a panel


def plot_prior_sensitivity(
    table: pd.DataFrame | xr.Dataset, *, backend: str | None = None, **pc_kwargs: Any
) -> PlotCollection:
    """Plot the dependence of model probabilities on the prior.

    Parameters
    ----------
    table : pandas.DataFrame or xarray.Dataset
        The table of `compare_evidence`: one panel, the probabilities against the exponent of
        `DimensionCorrection`, ignoring the correction in the table. Or the result of
        `prior_sensitivity`: a second panel, against the width of the priors, if it has one. Its
        label names the priors that were left out, or because of which the panel is empty.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``curve``, ``band``.

    Raises
    ------
    ModelError
        If `table` is neither.

    Examples
    --------
    >>> from pymc_statespace_filters import Evidence, compare_evidence, plot_prior_sensitivity
    >>> linear = Evidence(-41.0, 0.3, "chib_jeliazkov", 2, 100, -35.0, "0c5f")
    >>> cubic = Evidence(-39.0, 0.2, "chib_jeliazkov", 3, 100, -31.0, "0c5f")
    >>> collection = plot_prior_sensitivity(compare_evidence({"linear": linear, "cubic": cubic}))
    >>> collection.savefig("sensitivity.png")  # doctest: +SKIP
    """
    found = _sensitivity(table)
    panels = [name for name in LABELS if name in found]
    if "width_prob" in panels:  # not every backend of arviz_plots has a logarithmic axis
        found = found.assign_coords(width=np.log10(found["width"]))
    probs = found[panels]
    low, high = (
        found[[f"{name}_{end}" for name in panels]].rename(
            {f"{name}_{end}": name for name in panels}
        )
        for end in ("low", "high")
    )
    collection = canvas(
        probs,
        backend=backend,
        pc_kwargs=pc_kwargs,
        aes={"color": ["model"]},
        n_panels=len(panels),
        legend=True,
        cols=["__variable__"],
    )
    collection.map(band, "band", data=interval(low, high), alpha=0.25)
    collection.map(curve, "curve", width=2)
    _label_axes(collection, probs)
    collection.add_legend("model")
    return collection


def _label_axes(collection: PlotCollection, probs: xr.Dataset) -> None:
    labels = LABELS | {"width_prob": LABELS["width_prob"] + _about_priors(probs)}
    settings: dict[str, Any] = {"ignore_aes": "all", "store_artist": False}
    panels = probs.fillna(0.0)  # arviz_plots draws nothing, labels neither, where all is missing
    for name in panels:
        collection.map(labelled_x, data=panels[[name]], text=labels[str(name)], **settings)
        collection.map(labelled_y, data=panels[[name]], text="probability of the model", **settings)
    collection.map(set_ylim, data=panels, limits=(-0.02, 1.02), **settings)
    if "width_prob" in panels:
        ticks = logarithmic_ticks(panels["width"].values)
        collection.map(set_xticks, data=panels[["width_prob"]], **ticks, **settings)


def _about_priors(probs: xr.Dataset) -> str:
    """Further lines of the label: priors that were left out, or that leave the panel empty."""
    notes = {
        "without the prior of": probs.attrs.get("width_left_out"),
        "mostly unknown due to the prior of": probs.attrs.get("width_unknown"),
    }
    return "".join(
        "\n" + fill(f"{text} {names}", LABEL_WIDTH) for text, names in notes.items() if names
    )


def _sensitivity(table: pd.DataFrame | xr.Dataset) -> xr.Dataset:
    if isinstance(table, pd.DataFrame):
        return prior_sensitivity(table)
    if isinstance(table, xr.Dataset) and {"prob", "prob_low", "prob_high"} <= set(table):
        return table
    raise ModelError(
        f"table must be one of compare_evidence or a result of prior_sensitivity, got {table!r}"
    )
