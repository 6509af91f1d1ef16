"""Plot of model probabilities against the width of the priors."""

from textwrap import fill
from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object
from arviz_plots.visuals import labelled_x, labelled_y, set_xlim, set_xticks, set_ylim

from ..errors import ModelError
from .canvas import band, canvas, curve, interval, logarithmic_ticks, size_of_panels, style_of_curve
from .legend import add_legend

AES = ["color", "linestyle"]
ENDS = ("width_prob_low", "width_prob_high")
LABEL_WIDTH, NOTE_WIDTH = 44, 32  # characters, of a line below the panel and inside it
LINE = 0.22  # inches, of a line below a panel


def plot_prior_sensitivity(
    curves: xr.Dataset, *, backend: str | None = None, **pc_kwargs: Any
) -> PlotCollection:
    """Plot model probabilities against the width of the priors.

    Parameters
    ----------
    curves : xarray.Dataset
        The result of `prior_sensitivity`, the attribute ``widths`` of that of `drift_evidence`, or
        the group ``widths`` of that of `select_terms`, by its ``to_dataset()``.
        The label of the axis names the priors that were left out, or because of which the panel is
        empty. A curve has no points where the draws do not determine the result; an empty panel
        tells why.
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
        If `curves` is something else.

    Examples
    --------
    >>> import numpy as np
    >>> import xarray as xr
    >>> from pymc_statespace_filters import plot_prior_sensitivity
    >>> prob = np.array([[0.2, 0.5, 0.7], [0.8, 0.5, 0.3]])
    >>> curves = xr.Dataset(
    ...     {
    ...         "width_prob": (("model", "width"), prob),
    ...         "width_prob_low": (("model", "width"), prob - 0.1),
    ...         "width_prob_high": (("model", "width"), prob + 0.1),
    ...     },
    ...     coords={"model": ["linear", "cubic"], "width": [0.5, 1.0, 2.0]},
    ... )
    >>> collection = plot_prior_sensitivity(curves)
    >>> collection.savefig("sensitivity.png")  # doctest: +SKIP
    """
    if not (isinstance(curves, xr.Dataset) and {"width_prob", *ENDS} <= set(curves)):
        raise ModelError(
            "curves must be the result of prior_sensitivity, or the widths of that of "
            f"drift_evidence, got {curves!r}"
        )
    # Not every backend of arviz_plots has a logarithmic axis.
    found = curves.assign_coords(width=np.log10(curves["width"]))
    probs = found[["width_prob"]]
    low, high = (found[[name]].rename({name: "width_prob"}) for name in ENDS)
    width, height = size_of_panels(1)
    models = [str(name) for name in probs["model"].values]
    styles = [style_of_curve(i) for i in range(len(models))]
    collection = canvas(
        probs,
        backend=backend,
        pc_kwargs=pc_kwargs,
        aes={name: ["model"] for name in AES},
        color=[style["color"] for style in styles],
        linestyle=[style["linestyle"] for style in styles],
        key=[*models, "interval"],
        size=(width, height + LINE * _about_priors(probs).count("\n")),
        n_panels=1,
        cols=["__variable__"],
    )
    collection.map(band, "band", data=interval(low, high), alpha=0.25, ignore_aes={"linestyle"})
    collection.map(curve, "curve", width=2)
    _label_axes(collection, probs)
    _note_empty(collection, found)
    legend = {
        name: {**collection.get_aes_kwargs(AES, "mapping", {"model": name}), "width": 2}
        for name in models
    }
    if low["width_prob"].notnull().any():
        share = f"{100 * found.attrs['ci_prob']:g} % " if "ci_prob" in found.attrs else ""
        legend[f"{share}interval"] = {"color": "B3", "alpha": 0.4, "width": 8}
    add_legend(collection, legend)
    return collection


def _label_axes(collection: PlotCollection, probs: xr.Dataset) -> None:
    # A panel without results has axes too.
    settings: dict[str, Any] = {
        "data": probs.fillna(0.0),
        "ignore_aes": "all",
        "store_artist": False,
    }
    text = "width of the priors (factor)" + _about_priors(probs)
    collection.map(labelled_x, text=text, **settings)
    of_what = f"probability of the {probs.attrs.get('width_of', 'model')}"
    collection.map(labelled_y, text=of_what, **settings)
    collection.map(set_ylim, limits=(-0.02, 1.02), **settings)
    if probs["width_prob"].isnull().all():
        ends = probs["width"].values[[0, -1]]
        margin = 0.05 * (ends[1] - ends[0])
        collection.map(set_xlim, limits=(ends[0] - margin, ends[1] + margin), **settings)
    collection.map(set_xticks, **logarithmic_ticks(probs["width"].values), **settings)


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
    """Write into the panel why it is empty, if it is."""
    if found["width_prob"].notnull().any():
        return
    why = found.attrs.get("width_note") or "the draws do not determine it"
    lines = [fill(line, NOTE_WIDTH) for line in ("no result at any width:", why)]
    data = xr.Dataset({"width_prob": found["width"].values[[0, -1]].mean()})
    collection.map(note, "note", data=data, ignore_aes="all", text="\n".join(lines), color="B2")


def note(da: xr.DataArray, target: Any, *, text: str, **kwargs: Any) -> Any:
    """Write a text in the middle of a panel of probabilities."""
    return backend_from_object(target).text(da.item(), 0.5, text, target, **kwargs)
