"""Plot of rival models row by row: which observations speak for which of them."""

from collections.abc import Mapping
from typing import Any

import xarray as xr
from arviz_plots import PlotCollection

from ..evidence import compare_evidence
from .picture import Mark, along_models, picture, style_of_curve
from .shapes import band, bars, curve, from_zero, interval

N_ERRORS = 2  # of standard errors, of a band
PANELS = {
    "score_difference": "score difference",
    "log_bayes_factor": "log Bayes factor",
    "probability": "probability",
}


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
        Visuals ``bar`` of the variable ``score_difference``, and ``curve`` and ``band`` of
        ``log_bayes_factor`` and ``probability``, along ``model``.

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
    table = compare_evidence(results, by="row")
    models = [str(name) for name in table["model"].values]
    spread = N_ERRORS * table["log_bayes_factor_se"]
    low, high = (
        xr.Dataset(
            {"log_bayes_factor": table["log_bayes_factor"] + sign * spread, "probability": p}
        )
        for sign, p in ((-1, table["probability_low"]), (1, table["probability_high"]))
    )
    scores, courses = table[["score_difference"]], table[["log_bayes_factor", "probability"]]
    texts = [f"{models[0]} (reference)", *models[1:]]
    return picture(
        table[list(PANELS)],
        [
            Mark(bars, "bar", from_zero(scores), {"width": 1.5}),
            Mark(band, "band", interval(low, high), {"alpha": 0.25}),
            Mark(curve, "curve", courses, {"width": 1.5}, dict(zip(models, texts, strict=True))),
        ],
        x="time",
        y=PANELS,
        cols=["__variable__"],
        backend=backend,
        pc_kwargs=pc_kwargs,
        aesthetics=along_models([style_of_curve(i) for i in range(len(models))]),
    )
