"""Plot of rival models row by row: which observations speak for which of them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.plot_collection import backend_from_object

from ..evidence import compare_evidence
from .canvas import band, curve, interval, label_axes, style_of_curve
from .legend import add_legend
from .marks import canvas_over_time

N_ERRORS = 2  # of standard errors, of a band
PANELS = "score_difference", "log_bayes_factor", "probability"


def plot_prequential(
    results: Mapping[str, xr.DataTree], *, backend: str | None = None, **pc_kwargs: Any
) -> PlotCollection:
    """Plot which observations favour which model, and the log Bayes factor after each of them.

    The first panel has for each row the difference of the scores log p(d_j | d_1 .. d_{j-1}) of
    each model to that of the first one; the parameters are integrated out. The second has their
    sum, the log Bayes factor of the rows so far, the third the probabilities of models that were
    equally likely before the data. Bands are two standard errors, or a 95 % interval of the
    probabilities by the errors of the evidences.

    Parameters
    ----------
    results : mapping of str to xarray.DataTree
        Results of `sample_smc` with ``data="sequential"``, or of `extend`, of at least two models
        of the same rows; the others are compared with the first.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``score_NAME``, ``factor_NAME``, ``factor_band_NAME``, ``probability_NAME`` and
        ``probability_band_NAME`` for each model, along ``panel``.

    Raises
    ------
    ModelError
        If `results` are not sequential runs of at least two models.
    DataMismatchError
        If they are of different rows or data.

    See Also
    --------
    compare_evidence : The numbers, with ``by="row"``.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.5]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> def run(centre):
    ...     with pm.Model():
    ...         pm.Normal("a", centre, 0.2)
    ...         psf.StateSpace("d", system, psf.EKF(), steps=[1, 2, 3], observed=[0.1, 0.9, 1.2])
    ...         return psf.sample_smc(50, data="sequential", random_seed=1, progressbar=False)
    >>> collection = psf.plot_prequential({"persistent": run(0.9), "alternating": run(-0.9)})
    >>> collection.savefig("prequential.png")  # doctest: +SKIP
    """
    table = compare_evidence(results, by="row").rename(row="time")
    models = [str(name) for name in table["model"].values]
    first = table[PANELS[0]].isel(model=0, drop=True)
    shape = xr.Dataset({"value": first.expand_dims(panel=list(PANELS))})
    texts = [f"{models[0]} (reference)", *models[1:]]
    collection = canvas_over_time(
        shape, "panel", 1, backend=backend, pc_kwargs=pc_kwargs, key=texts
    )
    styles = {name: style_of_curve(i) for i, name in enumerate(models)}
    for name, style in styles.items():
        _draw_model(collection, table.sel(model=name, drop=True), name, style)
    labels = ["score difference", "log Bayes factor", "probability"]
    label_axes(collection, labels, "time")
    entries = {t: {**style, "width": 2} for t, style in zip(texts, styles.values(), strict=True)}
    add_legend(collection, entries)
    return collection


def _draw_model(
    collection: PlotCollection, course: xr.Dataset, name: str, style: dict[str, Any]
) -> None:
    """Draw one model in all panels."""

    def in_panel(panel: str, values: xr.DataArray) -> xr.Dataset:
        only = values.expand_dims(panel=[panel]).reindex(panel=list(PANELS))
        return xr.Dataset({"value": only})

    scores, factor = course["score_difference"], course["log_bayes_factor"]
    spread = N_ERRORS * course["log_bayes_factor_se"]
    bounds = {
        "factor": ("log_bayes_factor", factor - spread, factor + spread),
        "probability": ("probability", course["probability_low"], course["probability_high"]),
    }
    collection.map(stems, f"score_{name}", data=in_panel(PANELS[0], scores), width=1.5, **style)
    for short, (panel, low, high) in bounds.items():
        ends = interval(in_panel(panel, low), in_panel(panel, high))
        collection.map(band, f"{short}_band_{name}", data=ends, alpha=0.25, color=style["color"])
        values = in_panel(panel, course[panel])
        collection.map(curve, f"{short}_{name}", data=values, width=1.5, **style)


def stems(da: xr.DataArray, target: Any, **kwargs: Any) -> Any:
    """Draw a line from zero to each value."""
    (dim,) = da.dims
    times, values = np.repeat(da[dim].values, 3), np.zeros(3 * da.size)
    values[1::3], values[2::3] = da.values, np.nan
    return backend_from_object(target).line(times, values, target, **kwargs)
