"""Plot of replicated observations beside the data."""

from collections.abc import Callable, Mapping
from typing import Any

import pymc as pm
import xarray as xr
from arviz_plots import PlotCollection

from ..former_names import former_names
from .forecast import plot_forecast, predicted
from .panels import with_rows_of_panel
from .results import group_of, variable_of


@former_names(record="give records=, a label or several")
def plot_predictive(
    idata: xr.DataTree,
    *,
    model: pm.Model | None = None,
    group: str = "posterior_predictive",
    var_name: str | None = None,
    records: Any = None,
    transform: Callable[[Any], Any] | Mapping[str, Callable[[Any], Any]] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> PlotCollection:
    """Plot replicated observations and the data over time, one panel per observable.

    Bands contain 50 % and 90 % of the draws of ``pm.sample_posterior_predictive``: whole new
    records with the inputs and steps of the data, in which the parameters' uncertainty, the process
    noise and the observation noise are included. ``az.plot_ppc_dist`` pools all times.

    Parameters
    ----------
    idata : xarray.DataTree
        Draws with a group of replicated observations, and the data.
    model : pymc.Model, optional
        The model, whose records of a panel are then called by labels that are texts. Otherwise they
        have numbers, unless a variable in `idata` has the dimension of the records.
    group : str
        The group: ``"posterior_predictive"``, or ``"prior_predictive"``.
    var_name : str, optional
        Name of the StateSpace variable, if there are several.
    records : label or sequence of labels, optional
        The records of a panel to show; by default the first twelve.
    transform : callable or mapping of str to callable, optional
        Function of an array that is applied to observations and draws before they are drawn; or a
        mapping from names of observables to such functions.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``band_90``, ``band_50``, ``median`` and ``data``, along ``observable``.

    Raises
    ------
    ModelError
        If there is no such group or variable, or a name or label does not match.

    See Also
    --------
    plot_forecast : Predictions after the data, or of a free run on other data.

    Examples
    --------
    >>> import numpy as np
    >>> import xarray as xr
    >>> from pymc_statespace_filters import plot_predictive
    >>> times, rng = np.arange(100) / 10, np.random.default_rng(1)
    >>> of_rows = {"d_time": times, "observable": ["position"]}
    >>> drawn = np.sin(times)[:, None] + 0.1 * rng.normal(size=(2, 100, 100, 1))
    >>> replicated = {"d": (("chain", "draw", "d_time", "observable"), drawn)}
    >>> data = {"d": (("d_time", "observable"), drawn[0, 0])}
    >>> idata = xr.DataTree.from_dict({
    ...     "posterior_predictive": xr.Dataset(replicated, of_rows),
    ...     "observed_data": xr.Dataset(data, of_rows),
    ... })
    >>> collection = plot_predictive(idata)
    >>> collection.savefig("replicated.png")  # doctest: +SKIP
    """
    group, results = group_of(idata, group)
    name = variable_of(predicted(results), var_name)
    return plot_forecast(
        with_rows_of_panel(idata, group, name, _labels_of_records(idata, name, model)),
        group=group,
        var_name=name,
        records=records,
        transform=transform,
        backend=backend,
        **pc_kwargs,
    )


def _labels_of_records(idata: xr.DataTree, name: str, model: pm.Model | None) -> list[Any] | None:
    """The labels of the records of a panel, of the model or of a variable that is along them."""
    dim = f"{name}_record"
    if model is not None and dim in model.coords:
        return list(model.coords[dim])
    found = [node.coords[dim] for node in idata.children.values() if dim in node.coords]
    return list(found[0].values.tolist()) if found else None
