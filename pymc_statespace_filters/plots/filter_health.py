"""Plot of filter diagnostics: residuals, their autocorrelation, PIT, effective particles."""

from functools import lru_cache
from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.visuals import hline, hspan
from arviz_stats.ecdf_utils import (
    compute_ecdf,
    get_pointwise_confidence_band,
    simulate_confidence_bands,
)
from scipy.stats import norm

from ..former_names import former_names
from .over_time import over_draws, spread_of
from .picture import Mark, picture, titles_of
from .results import diagnostics_of, time_label
from .shapes import (
    EXPECTED,
    band,
    bars,
    curve,
    from_zero,
    interval,
    logarithmic_ticks,
    point_size,
    points,
    y_ticks,
)

COLLAPSED = 3  # effective particles below which a filter counts as collapsed
PROB, TAIL = 0.95, 1.96  # of the bands expected of a calibrated filter
PIT_GRID = np.linspace(0, 1, 101)
N_SIMULATIONS = 1000  # of uniform numbers, for the simultaneous band of their ECDF
SEEN = {"color": "C0"}
CUT = {"color": "C1", "marker": "C3", "diameter": 6}
LIMIT = {"color": "B1", "linestyle": "C1"}
SIZE, PANELS_IN_LINE = (3.8, 2.6), 4  # inches of a panel
AXES = {
    "residual": ("time", "standardised residual"),
    "autocorrelation": ("lag (observations)", "autocorrelation"),
    "pit": ("PIT: probability of less", "share below − expected"),
    "inputs": ("lag (observations)", "correlation with inputs"),
    "effective": ("time", "effective number"),
}


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
    * the autocorrelation of the innovations: white noise stays within
      :math:`\pm 1.96 / \sqrt{J}`;
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
    found, _ = diagnostics_of(idata, "residual", var_name, record)
    residual = found["residual"]
    chance = residual.count("time") ** -0.5
    panels, bounds = {"residual": residual}, {"residual": 0.0 * chance + TAIL}
    if _has(found, "autocorrelation"):
        panels["autocorrelation"], bounds["autocorrelation"] = (
            found["autocorrelation"],
            TAIL * chance,
        )
    pit, pit_bounds = _pit(found["pit"])
    panels["pit"] = pit["pit"]
    if _has(found, "input_correlation"):
        panels["inputs"], largest = _largest(found["input_correlation"])
        bounds["inputs"] = largest * chance
    shown, limits = xr.Dataset(panels), xr.Dataset(bounds)
    lags = shown.drop_vars(["residual", "pit"])
    key = "95 % if calibrated"
    marks = [
        Mark(hspan, "expected", interval(-limits, limits), EXPECTED, key),
        Mark(band, "expected", pit_bounds, EXPECTED),
        Mark(points, "seen", shown[["residual"]], {**SEEN, **point_size(residual)}),
        Mark(bars, "seen", from_zero(lags), {**SEEN, "width": 2}),
        Mark(curve, "seen", pit, {**SEEN, "width": 1.5}),
    ]
    if "clipped" in found:
        marks.append(
            Mark(points, "clipped", shown[["residual"]].where(found["clipped"]), CUT, "further out")
        )
    n_columns = residual.sizes["observable"]
    title = dict.fromkeys(
        map(str, shown), titles_of(shown, ["observable"]) if n_columns > 1 else ""
    )
    if _has(found, "n_effective") and np.isfinite(found["n_effective"]).any():
        logs, of_effective = _effective(found)
        shown, marks = shown.assign(logs), marks + of_effective
        title["effective"] = _failures(idata)
    time = time_label(residual)
    return picture(
        shown,
        marks,
        x={name: time if label == "time" else label for name, (label, _) in AXES.items()},
        y={name: label for name, (_, label) in AXES.items()},
        title=title,
        cols=["__variable__", "observable"],
        size=SIZE,
        in_line=2 if n_columns == 1 else min(n_columns, PANELS_IN_LINE),
        backend=backend,
        pc_kwargs=pc_kwargs,
    )


def _has(found: xr.Dataset, name: str) -> bool:
    """Whether there are values to draw."""
    return name in found and bool(found[name].notnull().any())


def _largest(correlation: xr.DataArray) -> tuple[xr.DataArray, float]:
    """Return the correlation with inputs that is furthest from zero at each lag.

    And the bound of the largest of as many standard normals as there are inputs.
    """
    place = abs(correlation).fillna(0.0).argmax("input")
    n_inputs = correlation.sizes["input"]
    bound = norm.isf((1 - PROB ** (1 / n_inputs)) / 2)
    return correlation.isel(input=place).drop_vars("input"), bound


def _pit(pit: xr.DataArray) -> tuple[xr.Dataset, xr.Dataset]:
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


def _effective(found: xr.Dataset) -> tuple[xr.Dataset, list[Mark]]:
    """Return log10 of the effective number (not every backend has a log axis) and its marks."""
    effective = found["n_effective"].where(np.isfinite(found["n_effective"]))
    logs = xr.apply_ufunc(np.log10, effective).to_dataset(name="effective")
    quantiles, limit = over_draws(logs), np.log10(COLLAPSED)
    ends = np.array([min(logs["effective"].min(), limit), logs["effective"].max()])
    below, above = spread_of(quantiles)
    return logs, [
        *below,
        *above,
        Mark(hline, "collapsed", xr.Dataset({"effective": limit}), LIMIT, "collapse"),
        Mark(y_ticks, None, logs, logarithmic_ticks(ends)),
    ]


def _failures(idata: xr.DataTree) -> str:
    """The number of evaluations that failed while sampling, if any did."""
    stats = idata.children.get("sample_stats")
    n_failed = 0 if stats is None or "n_failed" not in stats else int(stats["n_failed"].sum())
    return f"{n_failed} evaluations failed" if n_failed else ""
