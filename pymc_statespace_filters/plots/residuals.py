"""Plot of the innovations of a filter: over time, and against what they should not depend on."""

from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.visuals import hline, hspan

from ..diagnostics.calibration import standardised
from ..errors import ModelError
from ..former_names import former_names
from .picture import Mark, picture, titles_of, with_unit
from .results import SAMPLE_DIMS, diagnostics_of, group_of, time_label, unit_of
from .shapes import EXPECTED, ZERO, bars, from_zero, interval, point_size, points

TAIL = 1.96  # of the 95 % band of a standard normal
SEEN = {"color": "C0"}
WIDTH, WIDTH_ALONE, HEIGHT = 4.2, 7.0, 2.6  # inches of a column, of a single one, of a panel


@former_names
def plot_residuals(
    idata: xr.DataTree,
    *,
    var_name: str | None = None,
    record: Any = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> PlotCollection:
    r"""Plot the innovations of a filter: observations minus their one-step-ahead predictions.

    One column of panels per observable, with the innovations divided by their standard deviations.
    Of a right model they are white noise, independent of everything before; grey is where 95 % of
    them, or of their correlations, are expected:

    * over time;
    * their autocorrelation, within :math:`\pm 1.96 / \sqrt{J}`: what is outside is dynamics that
      the model lacks;
    * for a system with inputs, their correlation with each input so many observations earlier:
      outside, that input acts otherwise than in the model;
    * against the prediction: a curve shows a wrong restoring force or sensor law, a spread that
      grows with the amplitude shows noise that does.

    An observable without observations and an input that never changes have no panel.

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
        Visuals ``expected``, ``zero`` and ``seen`` of the variables ``innovation``,
        ``autocorrelation``, ``prediction`` and, for each input, ``input_NAME``, along
        ``observable``.

    Raises
    ------
    ModelError
        If `idata` has no such group or no observation, or `var_name` is none of its variables.

    See Also
    --------
    plot_filter_health : the calibration of the predictions, and the particles behind them.

    Examples
    --------
    >>> import numpy as np
    >>> import xarray as xr
    >>> from pymc_statespace_filters import plot_residuals
    >>> rng = np.random.default_rng(1)
    >>> dims = ("d_time", "observable")
    >>> diagnostics = xr.Dataset(
    ...     {
    ...         "d_innovation": (dims, 2.0 * rng.normal(size=(100, 1))),
    ...         "d_innovation_cov": ((*dims, "observable_2"), np.full((100, 1, 1), 4.0)),
    ...         "d_autocorrelation": (("lag", "observable"), 0.1 * rng.normal(size=(20, 1))),
    ...         "d_predicted": (("chain", "draw", *dims), rng.normal(size=(2, 50, 100, 1))),
    ...     },
    ...     coords={"d_time": np.arange(100) / 10, "lag": np.arange(1, 21), "observable": ["x"]},
    ... )
    >>> idata = xr.DataTree.from_dict({"filter_diagnostics": diagnostics})
    >>> collection = plot_residuals(idata)
    >>> collection.savefig("residuals.png")  # doctest: +SKIP
    """
    _, results = group_of(idata, "filter_diagnostics")
    if not any(str(name).endswith("_innovation") for name in results):
        raise ModelError(
            "idata's group 'filter_diagnostics' has no innovations: run "
            "psf.filter_diagnostics(idata, model) again"
        )
    found, data = diagnostics_of(idata, "innovation", var_name, record)
    z = found["innovation"].copy(
        data=standardised(found["innovation"].values, found["innovation_cov"].values)
    )
    if data is None:
        predicted = found["predicted"].mean(SAMPLE_DIMS)
    else:
        predicted = data - found["innovation"]
    panels = _panels(found, z, predicted)
    observables = panels["observable"].values
    names = [f"predicted {with_unit(str(one), unit_of(one, z, data))}" for one in observables]
    x = {row: f"lag of {row.removeprefix('input_')} (observations)" for row in map(str, panels)} | {
        "innovation": time_label(z, data),
        "autocorrelation": "lag (observations)",
        "prediction": panels["observable"].copy(data=np.array(names, dtype=object)),
    }
    y = dict.fromkeys(map(str, panels), "correlation") | {
        "innovation": "standardised innovation",
        "autocorrelation": "autocorrelation",
        "prediction": "standardised innovation",
    }
    n_columns = observables.size
    titles = titles_of(panels, ["observable"]) if n_columns > 1 else ""
    return picture(
        panels,
        _marks(panels),
        x=x,
        y=y,
        title={"innovation": titles},
        cols=["__variable__", "observable"],
        size=(WIDTH_ALONE if n_columns == 1 else WIDTH, HEIGHT),
        in_line=n_columns,
        backend=backend,
        pc_kwargs=pc_kwargs,
    )


def _panels(found: xr.Dataset, z: xr.DataArray, predicted: xr.DataArray) -> xr.Dataset:
    """Return what is drawn, one variable for each row of panels that has values."""
    rows = {"innovation": z, "autocorrelation": found["autocorrelation"]}
    if "input_correlation" in found:
        for one in found["input"].values:
            rows[f"input_{one}"] = found["input_correlation"].sel(input=one, drop=True)
    rows["prediction"] = xr.concat([predicted, z], "plot_axis").assign_coords(plot_axis=["x", "y"])
    return xr.Dataset({row: one.drop_attrs() for row, one in rows.items() if one.notnull().any()})


def _marks(panels: xr.Dataset) -> list[Mark]:
    """Innovations as points, correlations as bars, and where white noise is expected."""
    z = panels["innovation"]
    rows = ["innovation", "prediction"]
    lags = panels.drop_vars(rows)
    chance = TAIL * z.count("time") ** -0.5
    bounds = xr.Dataset({row: chance if row in lags else 0.0 * chance + TAIL for row in panels})
    key = "95 % if the model is right"
    return [
        Mark(hspan, "expected", interval(-bounds, bounds), EXPECTED, key),
        Mark(hline, "zero", xr.zeros_like(bounds), ZERO),
        Mark(points, "seen", panels[rows], {**SEEN, **point_size(z)}),
        Mark(bars, "seen", from_zero(lags), {**SEEN, "width": 2}),
    ]
