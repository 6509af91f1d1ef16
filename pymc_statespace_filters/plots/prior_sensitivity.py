"""Plot of model probabilities against the correction's exponent and the width of priors."""

from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object
from arviz_plots.visuals import labelled_x, labelled_y, set_xlim, set_xticks, set_ylim

from ..errors import ModelError
from ..evidence import prior_sensitivity
from ..evidence.comparison.scaled_prior import MAX_BEYOND, MAX_PARETO_K
from .canvas import add_legend, band, canvas, curve, interval, logarithmic_ticks, size_of_panels

LABELS = {
    "prob": ("exponent", "exponent α of the correction"),
    "width_prob": ("width", "width of the priors (factor)"),
}
LABEL_WIDTH, NOTE_WIDTH = 44, 32  # characters, of a line below a panel and inside it


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
        label names the priors that were left out, or because of which the panel is empty. A curve
        has no points where the draws do not determine the result; an empty panel tells why.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``curve``, ``band``, ``note``.

    Raises
    ------
    ModelError
        If `table` is neither.

    Examples
    --------
    >>> from pymc_statespace_filters import compare_evidence, plot_prior_sensitivity
    >>> from pymc_statespace_filters.evidence import Evidence
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
        size=size_of_panels(len(panels)),
        n_panels=len(panels),
        cols=["__variable__"],
    )
    collection.map(band, "band", data=interval(low, high), alpha=0.25)
    collection.map(curve, "curve", width=2)
    _label_axes(collection, probs)
    _note_empty(collection, found)
    legend = {
        str(name): {**collection.get_aes_kwargs(["color"], "mapping", {"model": name}), "width": 2}
        for name in probs["model"].values
    }
    if low.notnull().any().to_array().any():
        share = f"{100 * found.attrs['ci_prob']:g} % " if "ci_prob" in found.attrs else ""
        legend[f"{share}interval"] = {"color": "B3", "alpha": 0.4, "width": 8}
    add_legend(collection, legend)
    return collection


def _label_axes(collection: PlotCollection, probs: xr.Dataset) -> None:
    settings: dict[str, Any] = {"ignore_aes": "all", "store_artist": False}
    panels = probs.fillna(0.0)  # a panel without results has axes too
    further = {"width_prob": _about_priors(probs)} if "width_prob" in probs else {}
    for name, (dim, label) in LABELS.items():
        if name not in probs:
            continue
        data, ends = panels[[name]], probs[dim].values[[0, -1]]
        text = label + further.get(name, "")
        collection.map(labelled_x, data=data, text=text, **settings)
        collection.map(labelled_y, data=data, text="probability of the model", **settings)
        collection.map(set_ylim, data=data, limits=(-0.02, 1.02), **settings)
        if probs[name].isnull().all():
            margin = 0.05 * (ends[1] - ends[0])
            limits = (ends[0] - margin, ends[1] + margin)
            collection.map(set_xlim, data=data, limits=limits, **settings)
    if "width_prob" in probs:
        ticks = logarithmic_ticks(probs["width"].values)
        collection.map(set_xticks, data=panels[["width_prob"]], **ticks, **settings)


def _about_priors(probs: xr.Dataset) -> str:
    """Further lines of the label: priors left out, or unknown; widths without a result."""
    notes = {
        "without the prior of": probs.attrs.get("width_left_out"),
        "mostly unknown due to the prior of": probs.attrs.get("width_unknown"),
    }
    lines = [fill(f"{text} {names}", LABEL_WIDTH) for text, names in notes.items() if names]
    missing = probs["width_prob"].isnull().any("model")
    if missing.any() and not missing.all():  # an empty panel has a note
        lines.append(f"no result at {int(missing.sum())} of {missing.size} widths")
    return "".join(f"\n{line}" for line in lines)


def _note_empty(collection: PlotCollection, found: xr.Dataset) -> None:
    """Write into the panel of widths why it is empty, if it is."""
    if "width_prob" not in found or found["width_prob"].notnull().any():
        return
    lines = [fill(line, NOTE_WIDTH) for line in ("no result at any width:", *_reasons(found))]
    data = xr.Dataset({"width_prob": found["width"].values[[0, -1]].mean()})
    collection.map(note, "note", data=data, ignore_aes="all", text="\n".join(lines), color="B2")


def _reasons(found: xr.Dataset) -> list[str]:
    """Return for each model why its evidence is unknown under other priors."""
    causes = {
        "width_beyond": (MAX_BEYOND, "draws reach the bounds of a prior"),
        "width_pareto_k": (MAX_PARETO_K, "posterior about as wide as the prior"),
    }
    reasons = []
    for model in found["model"].values:
        of_model = found.sel(model=model)
        if "width_log_evidence" not in found or of_model["width_log_evidence"].notnull().all():
            continue
        unknown = of_model.where(of_model["width_log_evidence"].isnull())
        texts = [text for name, (limit, text) in causes.items() if (unknown[name] > limit).any()]
        reasons.append(f"{model}: {texts[0] if texts else 'too few draws under these priors'}")
    return reasons or ["the draws do not determine it"]


def note(da: xr.DataArray, target: Any, *, text: str, **kwargs: Any) -> Any:
    """Write a text in the middle of a panel of probabilities."""
    return backend_from_object(target).text(da.item(), 0.5, text, target, **kwargs)


def _sensitivity(table: pd.DataFrame | xr.Dataset) -> xr.Dataset:
    if isinstance(table, pd.DataFrame):
        return prior_sensitivity(table)
    if isinstance(table, xr.Dataset) and {"prob", "prob_low", "prob_high"} <= set(table):
        return table
    raise ModelError(
        f"table must be one of compare_evidence or a result of prior_sensitivity, got {table!r}"
    )
