"""Plot of the summed scores of parameters over time, from `drift_scan`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.visuals import hline

from ..diagnostics.constancy.table import DriftScan
from ..errors import ModelError
from ..former_names import former_names
from .over_time import picture_over_time
from .picture import Mark
from .results import select_names, time_label
from .shapes import EXPECTED, ZERO, band, curve, interval, points

SUM = {"color": "C0", "width": 1.5}
TURN = {"color": "C1", "diameter": 6}
MOST_PANELS = 12


@former_names
def plot_drift(
    scan: pd.DataFrame,
    *,
    parameters: str | Sequence[str] | None = None,
    record: Any = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> PlotCollection:
    """Plot the summed scores of each parameter over time, with the band of a constant parameter.

    The path of a constant parameter stays within the grey band from beginning to end with 95 %
    probability. The sum of one that changes rises while the parameter is above its mean over the
    record, and falls while it is below: where it turns, the parameter changes.

    Parameters
    ----------
    scan : pandas.DataFrame
        The result of `drift_scan`.
    parameters : str or sequence of str, optional
        Those to show; by default the first twelve of the table that have scores. One at a bound
        may have none.
    record : label, optional
        The record of a panel, which has a figure of its own; by default the most suspicious one.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``constant``, ``zero``, ``sum`` and ``turn`` along ``parameter``.

    Raises
    ------
    ModelError
        If `scan` is something else, or a parameter or record is not in it.

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
    >>> record = psf.simulate(system, {"a": 0.5}, steps=range(50), random_seed=1)
    >>> with pm.Model():
    ...     a = pm.Uniform("a", -1, 1)
    ...     d = psf.StateSpace(
    ...         "d", system, psf.EKF(), steps=range(50), observed=record["observations"]
    ...     )
    ...     estimate = psf.maximum_likelihood(random_seed=1, progressbar=False)
    ...     scan = psf.diagnostics.drift_scan(estimate, n_simulated=19, random_seed=2)
    >>> collection = psf.plot_drift(scan)
    >>> collection.savefig("drift.png")  # doctest: +SKIP
    """
    if not isinstance(scan, DriftScan):
        raise ModelError(
            "scan must be the result of drift_scan, of which a part has no paths, got "
            f"{type(scan).__name__}"
        )
    paths = _of_record(scan, record)
    known = paths["cumulated"].notnull().any("time")
    names = [str(name) for name in scan.index if known.sel(parameter=name)]
    shown = select_names("parameters", parameters, names)
    shown = shown[:MOST_PANELS] if parameters is None else shown
    if not shown:
        raise ModelError(f"scan has summed scores of none of {list(scan.index)}: nothing to plot")
    paths = paths.sel(parameter=shown)
    sums = paths[["cumulated"]]
    bound = xr.ones_like(sums) * paths["band"]
    constant = interval(-bound, bound)
    turns = sums.where(paths["row_number"] == paths["turn"])
    return picture_over_time(
        sums,
        [
            Mark(band, "constant", constant, EXPECTED, "95 % of constant parameters"),
            Mark(hline, "zero", xr.zeros_like(sums.isel(time=0, drop=True)), ZERO),
            Mark(curve, "sum", sums, SUM, "summed scores (sd)"),
            Mark(points, "turn", turns, TURN, "time of the change"),
        ],
        [f"{name}, p = {scan.loc[name, 'p_value']:.3f}" for name in shown],
        x=time_label(sums["cumulated"]),
        backend=backend,
        pc_kwargs=pc_kwargs,
    )


def _of_record(scan: DriftScan, record: Any) -> xr.Dataset:
    """The paths over time of one record."""
    paths = scan.paths
    dim = paths["cumulated"].dims[-1]
    paths = paths.assign_coords(row_number=(dim, np.arange(paths.sizes[dim])))
    if "record" not in paths.coords:
        if record is not None:
            raise ModelError(f"record must be None without a panel, got {record!r}")
        return paths
    chosen = scan["record"].iloc[0] if record is None else record
    rows = np.flatnonzero(paths["record"].values == chosen)
    if not rows.size:
        labels = list(dict.fromkeys(paths["record"].values.tolist()))
        raise ModelError(f"record must be one of {labels}, got {record!r}")
    return paths.isel(row=rows).drop_vars("record").swap_dims(row="time")
