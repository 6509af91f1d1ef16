"""Plot of filter diagnostics: residuals, their autocorrelation, PIT, effective particles."""

from functools import lru_cache
from typing import Any

import numpy as np
import xarray as xr
from arviz_base.labels import NoVarLabeller
from arviz_plots import PlotCollection
from arviz_plots.visuals import hline, labelled_title, labelled_x, labelled_y
from arviz_stats.base import array_stats
from arviz_stats.ecdf_utils import (
    compute_ecdf,
    get_pointwise_confidence_band,
    simulate_confidence_bands,
)
from scipy.stats import norm

from ..former_names import former_names
from .canvas import (
    PANELS_IN_LINE,
    band,
    canvas,
    curve,
    interval,
    label_ticks,
    logarithmic_ticks,
    shorten_dates,
    time_label,
)
from .legend import add_legend, legend_style
from .marks import bars, draw_bands, draw_median, over_draws, point_size, points
from .panels import one_record
from .results import group_of, rename_last_dims, seen_observables, variable_of

COLLAPSED = 3  # effective particles below which a filter counts as collapsed
PROB, TAIL = 0.95, 1.96  # of the bands expected of a calibrated filter
MAX_LAG = 25
PIT_GRID = np.linspace(0, 1, 101)
N_SIMULATIONS = 1000  # of uniform numbers, for the simultaneous band of their ECDF
SEEN = {"color": "C0"}
EXPECTED = {"color": "B3", "alpha": 0.3}
CORRELATIONS = {"autocorrelation", "inputs"}  # drawn as bars over lags
CUT = {"color": "C1", "marker": "C3"}
LIMIT = {"color": "B1", "linestyle": "C1"}


@former_names
def plot_filter_health(
    idata: xr.DataTree,
    *,
    var_name: str | None = None,
    record: Any = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> PlotCollection:
    r"""Plot diagnostics of the one-step-ahead predictions of a filter.

    Three or four panels per observable, each with the 95 % band expected of a correct model:

    * the standardised residuals of one-step-ahead prediction over time. Many residuals outside the
      band, or long runs of one sign, show when the model is wrong. A residual that is further out
      than the draws can tell is crossed out;
    * their autocorrelation: white noise stays within :math:`\pm 1.96 / \sqrt{J}`;
    * the empirical distribution function of the probability integral transform (PIT) minus that of
      a uniform distribution, with a simultaneous band [1]_. Predictions that are too wide go below
      and then above the band, those that are too narrow the other way round; a bias lies on one
      side;
    * for a system with inputs, the correlation of the innovations with past inputs, of which that
      furthest from zero is drawn at each lag. Outside the band the inputs act otherwise than in the
      model.

    An observable without observations and inputs that never change have no panel.

    For particle and ensemble filters, one more panel with the effective number of particles behind
    each term of the log-likelihood, over the draws. Below 3 (the dashed line) the filter has
    collapsed. Its title is the number of
    evaluations that failed while sampling.

    Parameters
    ----------
    idata : xarray.DataTree
        With the group ``filter_diagnostics``.
    var_name : str, optional
        Name of the StateSpace variable, if there are several.
    record : label, optional
        The record of a panel, which has a figure of its own.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``expected`` and ``seen`` of the variables ``residual``, ``autocorrelation``,
        ``pit`` and ``inputs`` along ``observable``; ``clipped`` of ``residual``; ``band_90``,
        ``band_50``, ``median`` and ``collapsed`` of ``effective``.

    Raises
    ------
    ModelError
        If `idata` has no such group or no observation, or `var_name` is none of its variables.

    References
    ----------
    .. [1] Saeilynoja, Buerkner and Vehtari, Graphical test for discrete uniformity and its
       applications in goodness-of-fit evaluation and multiple sample comparison, Statistics and
       Computing 32, 2022.

    Examples
    --------
    >>> import numpy as np
    >>> import xarray as xr
    >>> from scipy.stats import norm
    >>> from pymc_statespace_filters import plot_filter_health
    >>> rng = np.random.default_rng(1)
    >>> residual = rng.normal(size=(100, 1))
    >>> diagnostics = xr.Dataset(
    ...     {
    ...         "d_residual": (("d_time", "observable"), residual),
    ...         "d_pit": (("d_time", "observable"), norm.cdf(residual)),
    ...         "d_n_effective": (("chain", "draw", "d_time"), rng.uniform(30, 90, (2, 50, 100))),
    ...     },
    ...     coords={"d_time": np.arange(100) / 10, "observable": ["position"]},
    ... )
    >>> idata = xr.DataTree.from_dict({"filter_diagnostics": diagnostics})
    >>> collection = plot_filter_health(idata)
    >>> collection.savefig("health.png")  # doctest: +SKIP
    """
    _, results = group_of(idata, "filter_diagnostics")
    name = variable_of(results, var_name, "_residual")
    idata = one_record(idata, "filter_diagnostics", name, record)
    results = idata["filter_diagnostics"].to_dataset()
    seen_ones = seen_observables(results[f"{name}_residual"])
    n_observables = seen_ones.size
    results = results.isel({results[f"{name}_residual"].dims[-1]: seen_ones})
    residual, pit = (
        rename_last_dims(results[f"{name}_{kind}"], "time", "observable")
        for kind in ("residual", "pit")
    )
    panels = [_residuals(residual), _autocorrelations(residual), _pits(pit)]
    if f"{name}_input_correlation" in results:
        panels.append(_input_correlations(results, name, residual))
    panels = [panel for panel in panels if panel[0].to_array().notnull().any()]
    seen, expected = (xr.merge(parts) for parts in zip(*panels, strict=True))
    effective = _log_effective(results, name)
    data = seen if effective is None else seen.assign(effective=effective)

    n_columns = residual.sizes["observable"]
    n_panels = len(panels) * n_columns + (effective is not None)
    in_line = 2 if n_columns == 1 else min(n_columns, PANELS_IN_LINE)
    collection = canvas(
        data,
        backend=backend,
        pc_kwargs=pc_kwargs,
        aes={},
        size=(3.8 * in_line, 0.6 + 2.6 * -(-n_panels // in_line)),
        n_panels=n_panels,
        panels_in_line=in_line,
        cols=["__variable__", "observable"],
    )
    collection.map(band, "expected", data=expected, **EXPECTED)
    size = point_size(residual)
    collection.map(points, "seen", data=seen[["residual"]], **size, **SEEN)
    for correlation in CORRELATIONS & set(seen):
        lags = seen[[correlation]]
        collection.map(bars, "seen", data=interval(xr.zeros_like(lags), lags), width=2, **SEEN)
    legend = {"95 % if calibrated": {**EXPECTED, "width": 8}}
    legend |= _mark_clipped(collection, seen[["residual"]], results.get(f"{name}_clipped"))
    collection.map(curve, "seen", data=seen[["pit"]], width=1.5, **SEEN)
    if effective is not None:
        legend |= _draw_effective(collection, data[["effective"]])
        _note_failures(collection, data[["effective"]], idata)
    _label_panels(collection, data, time_label(residual), n_observables)
    shorten_dates(collection)
    add_legend(collection, legend)
    return collection


def _residuals(residual: xr.DataArray) -> tuple[xr.Dataset, xr.Dataset]:
    """Return residuals over time, and the band of a standard normal."""
    bound = xr.full_like(residual, TAIL).to_dataset(name="residual")
    return residual.to_dataset(name="residual"), interval(-bound, bound)


def _autocorrelations(residual: xr.DataArray) -> tuple[xr.Dataset, xr.Dataset]:
    """Return autocorrelations of the non-missing residuals, and the band of white noise."""
    n_lags = max(1, min(MAX_LAG, residual.sizes["time"] // 4))

    def autocorrelation(values: np.ndarray) -> np.ndarray:
        found = array_stats.autocorr(values[np.isfinite(values)])[1 : n_lags + 1]
        return np.pad(found, (0, n_lags - found.size), constant_values=np.nan)

    lags = xr.apply_ufunc(
        autocorrelation,
        residual,
        input_core_dims=[["time"]],
        output_core_dims=[["lag"]],
        vectorize=True,
    ).assign_coords(lag=np.arange(1, n_lags + 1))
    bound = TAIL * residual.count("time") ** -0.5
    bounds = bound.expand_dims(lag=lags["lag"]).to_dataset(name="autocorrelation")
    return lags.to_dataset(name="autocorrelation"), interval(-bounds, bounds)


def _input_correlations(
    results: xr.Dataset, name: str, residual: xr.DataArray
) -> tuple[xr.Dataset, xr.Dataset]:
    """Return the correlations with the inputs, the largest at each lag, and the band of chance.

    The band is that of the largest of as many correlations as there are inputs.
    """
    found = results[f"{name}_input_correlation"]
    found = found.rename(input_lag="past", **{str(found.dims[-1]): "observable"})
    n_inputs = found.sizes["input"]
    place = abs(found).fillna(0.0).argmax("input")
    largest = found.isel(input=place).drop_vars("input")
    bound = norm.isf((1 - PROB ** (1 / n_inputs)) / 2) * residual.count("time") ** -0.5
    bounds = bound.expand_dims(past=largest["past"]).to_dataset(name="inputs")
    return largest.to_dataset(name="inputs"), interval(-bounds, bounds)


def _mark_clipped(
    collection: PlotCollection, residual: xr.Dataset, clipped: xr.DataArray | None
) -> dict[str, dict[str, Any]]:
    """Cross out every residual that is cut off; return its legend entry."""
    if clipped is None or not clipped.any():
        return {}
    cut = residual.where(rename_last_dims(clipped, "time", "observable"))
    collection.map(points, "clipped", data=cut, diameter=6, **CUT)
    return {"further out": legend_style(CUT)}


def _pits(pit: xr.DataArray) -> tuple[xr.Dataset, xr.Dataset]:
    """Return ECDFs minus the uniform distribution function, and their simultaneous band."""

    def of_one(values: np.ndarray) -> np.ndarray:
        values = values[np.isfinite(values)]
        found = [compute_ecdf(values, PIT_GRID[1:-1]), *_uniform_band(values.size)]
        return np.pad(np.array(found) - PIT_GRID[1:-1], ((0, 0), (1, 1)))  # zero at 0 and at 1

    found = xr.apply_ufunc(
        of_one,
        pit,
        input_core_dims=[["time"]],
        output_core_dims=[["of", "u"]],
        vectorize=True,
    ).assign_coords(u=PIT_GRID)
    seen, low, high = (found.isel(of=i).to_dataset(name="pit") for i in range(3))
    return seen, interval(low, high)


@lru_cache(maxsize=16)
def _uniform_band(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the simultaneous band of the ECDF of n uniform numbers."""
    rng = np.random.default_rng(1)  # reproducible plots
    level = simulate_confidence_bands(n, 1, PIT_GRID[1:-1], PROB, N_SIMULATIONS, rng)
    return get_pointwise_confidence_band(level, n, PIT_GRID[1:-1])


def _log_effective(results: xr.Dataset, name: str) -> xr.DataArray | None:
    """Return log10 of the effective number (not every backend has a log axis), or None."""
    effective = results.get(f"{name}_n_effective")
    if effective is None or not np.isfinite(effective).any():
        return None
    return xr.apply_ufunc(
        np.log10, rename_last_dims(effective.where(np.isfinite(effective)), "time")
    )


def _draw_effective(collection: PlotCollection, logs: xr.Dataset) -> dict[str, dict[str, Any]]:
    quantiles = over_draws(logs)
    legend = draw_bands(collection, quantiles)
    legend = draw_median(collection, quantiles) | legend
    limit = np.log10(COLLAPSED)
    collection.map(hline, "collapsed", data=xr.Dataset({"effective": limit}), **LIMIT)
    ends = np.array([min(logs["effective"].min(), limit), logs["effective"].max()])
    collection.map(
        label_ticks, data=logs, ticks=logarithmic_ticks(ends), ignore_aes="all", store_artist=False
    )
    return {**legend, "collapse": LIMIT}


def _note_failures(collection: PlotCollection, logs: xr.Dataset, idata: xr.DataTree) -> None:
    """Write the number of failed evaluations above the panel of effective particles."""
    stats = idata.children.get("sample_stats")
    n_failed = 0 if stats is None or "n_failed" not in stats else int(stats["n_failed"].sum())
    if n_failed:
        text = f"{n_failed} evaluations failed"
        collection.map(labelled_title, "failures", data=logs, text=text, ignore_aes="all")


def _label_panels(
    collection: PlotCollection, data: xr.Dataset, time: str, n_observables: int
) -> None:
    axes = {
        "residual": (time, "standardised residual"),
        "autocorrelation": ("lag (observations)", "autocorrelation"),
        "pit": ("PIT: probability of less", "share below − expected"),
        "inputs": ("lag (observations)", "correlation with inputs"),
        "effective": (time, "effective number"),
    }
    settings: dict[str, Any] = {"ignore_aes": "all", "store_artist": False}
    for panel in map(str, data):
        x_label, y_label = axes[panel]
        collection.map(labelled_x, data=data[[panel]], text=x_label, **settings)
        collection.map(labelled_y, data=data[[panel]], text=y_label, **settings)
    if n_observables > 1:
        of_observables = data.drop_vars("effective", errors="ignore")
        labels = {"labeller": NoVarLabeller(), "subset_info": True}
        collection.map(labelled_title, "title", data=of_observables, ignore_aes="all", **labels)
