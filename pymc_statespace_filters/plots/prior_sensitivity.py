"""Plot of model probabilities against the width of the priors."""

from textwrap import fill
from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object
from arviz_plots.visuals import set_xlim, set_xticks, set_ylim

from ..errors import ModelError
from .picture import Mark, along_models, picture, style_of_curve
from .rows import OF_PROBABILITIES
from .shapes import band, curve, interval, logarithmic_ticks

ENDS = ("width_prob_low", "width_prob_high")
SIZE, NOTE_WIDTH = (6.0, 3.2), 32  # inches of the panel; characters of a line inside it
LINE = 0.22  # inches, of a line below the panel
MARGIN = 0.05  # beside the widths, as a share of their range


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
    models = [str(name) for name in probs["model"].values]
    share = f"{100 * found.attrs['ci_prob']:g} % " if "ci_prob" in found.attrs else ""
    about = _about_priors(probs)
    ticks = logarithmic_ticks(probs["width"].values)
    shown = probs.fillna(0.0)  # a panel without results has axes too
    ends = found["width"].values[[0, -1]]
    margin = MARGIN * (ends[1] - ends[0])
    return picture(
        probs,
        [
            Mark(band, "band", interval(low, high), {"alpha": 0.25}, f"{share}interval"),
            Mark(curve, "curve", probs, {"width": 2}, {name: name for name in models}),
            Mark(set_ylim, None, shown, {"limits": OF_PROBABILITIES}),
            Mark(set_xticks, None, shown, ticks),
            Mark(set_xlim, None, shown, {"limits": (ends[0] - margin, ends[1] + margin)}),
            *_note_empty(found),
        ],
        x="width of the priors (factor)" + about,
        y=f"probability of the {probs.attrs.get('width_of', 'model')}",
        cols=["__variable__"],
        size=(SIZE[0], SIZE[1] + LINE * about.count("\n")),
        backend=backend,
        pc_kwargs=pc_kwargs,
        aesthetics=along_models([style_of_curve(i) for i in range(len(models))]),
    )


def _about_priors(probs: xr.Dataset) -> str:
    """Further lines of the label: priors left out, or unknown; widths without a result."""
    notes = {
        "without the prior of": probs.attrs.get("width_left_out"),
        "mostly unknown due to the prior of": probs.attrs.get("width_unknown"),
    }
    lines = [f"{text} {names}" for text, names in notes.items() if names]
    missing = probs["width_prob"].isnull().any("model")
    if missing.any() and not missing.all():  # an empty panel has a note
        lines.append(f"no result at {int(missing.sum())} of {missing.size} widths")
    return "".join(f"\n{line}" for line in lines)


def _note_empty(found: xr.Dataset) -> list[Mark]:
    """Write into the panel why it is empty, if it is."""
    if found["width_prob"].notnull().any():
        return []
    why = found.attrs.get("width_note") or "the draws do not determine it"
    text = "\n".join(fill(line, NOTE_WIDTH) for line in ("no result at any width:", why))
    middle = xr.Dataset({"width_prob": found["width"].values[[0, -1]].mean()})
    return [Mark(note, "note", middle, {"text": text, "color": "B2"})]


def note(da: xr.DataArray, target: Any, *, text: str, color: str, **kwargs: Any) -> Any:
    """Write a text in the middle of a panel of probabilities."""
    return backend_from_object(target).text(da.item(), 0.5, text, target, color=color)
