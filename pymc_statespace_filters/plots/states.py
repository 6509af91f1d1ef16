"""Plot of states over time with observations and the truth (thesis, Fig. 12)."""

from collections.abc import Mapping, Sequence
from typing import Any

import xarray as xr
from arviz_plots import PlotCollection

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.plots.canvas import curve
from pymc_statespace_filters.plots.marks import (
    DATA,
    DOTS,
    PATHS,
    TRUTH,
    add_legend,
    canvas_over_time,
    draw_bands,
    draw_bars,
    label_axes,
    legend_style,
    paths,
    points,
    thin_draws,
)
from pymc_statespace_filters.plots.results import (
    check_names,
    data_of,
    select_names,
    states_of,
    truth_of,
)
from pymc_statespace_filters.system.checks import check_count


def plot_states(
    idata: xr.DataTree,
    *,
    group: str | None = None,
    var_name: str | None = None,
    states: str | Sequence[str] | None = None,
    observables: Mapping[str, str] | None = None,
    truth: Any = None,
    n_draws: int = 0,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> PlotCollection:
    """Plot states over time with their uncertainty, one panel per state.

    Bands contain 50 % and 90 % of the draws, which include the uncertainty of the parameters; the
    line is their median. States at observation times only are shown as bars. Failed draws are
    ignored; where all failed there is a gap.

    Parameters
    ----------
    idata : xarray.DataTree
        Result of `filtered_states` or `smoothed_states`.
    group : {"smoothed_states", "filtered_states"}, optional
        By default the smoothed states if there are any.
    var_name : str, optional
        Name of the StateSpace variable, if there are several.
    states : str or sequence of str, optional
        Names of the states to show; all by default.
    observables : mapping of str to str, optional
        Maps a state to the observable that measures it; its observations are shown in the panel as
        points. By default each observable with the name of a state.
    truth : array_like or xarray.DataArray or xarray.Dataset, optional
        The result of `simulate`; a DataArray with a dimension ``state`` and another whose
        coordinate is time; or an array of shape (number of times, number of states). It is shown
        within the range of times of the states.
    n_draws : int
        Number of draws to show beside the bands: as lines for smoothed states at every step, as
        points for filtered states and for states at observation times only.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``: ``col_wrap=2`` gives two columns of panels.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``band_90``, ``band_50`` and ``median`` (or ``bar_90`` and ``bar_50``), ``data``,
        ``truth``, ``draws``, along ``state``.

    Raises
    ------
    ModelError
        If there are no such states, or a name or the truth does not match them.

    Examples
    --------
    >>> import numpy as np
    >>> import xarray as xr
    >>> from pymc_statespace_filters import plot_states
    >>> times, rng = np.linspace(0, 10, 101), np.random.default_rng(1)
    >>> draws = np.sin(times)[:, None] + 0.2 * rng.normal(size=(2, 100, 101, 1))
    >>> smoothed = xr.Dataset(
    ...     {"d_states": (("chain", "draw", "d_time", "state"), draws)},
    ...     coords={"d_time": times, "state": ["position"]},
    ... )
    >>> idata = xr.DataTree.from_dict({"smoothed_states": smoothed})
    >>> collection = plot_states(idata, truth=np.sin(times))
    >>> collection.savefig("states.png")  # doctest: +SKIP
    """
    check_count("n_draws", n_draws, 0)
    name, draws, at_observations, are_paths = states_of(idata, group, var_name)
    all_states = [str(state) for state in draws["state"].values]
    shown = select_names("states", states, all_states)
    record = _record(idata, name, observables, all_states)
    if truth is not None:
        truth = truth_of(truth, "states", "state", all_states, draws["time"].values)
        begin, end = draws["time"].values[[0, -1]]
        truth = truth.where((truth["time"] >= begin) & (truth["time"] <= end), drop=True)

    data = draws.sel(state=shown).to_dataset(name="states")
    collection = canvas_over_time(data, "state", backend=backend, pc_kwargs=pc_kwargs)
    if n_draws:
        mark, style = (paths, PATHS) if are_paths else (points, DOTS)
        collection.map(mark, "draws", data=thin_draws(data, n_draws), **style)
    legend = (draw_bars if at_observations else draw_bands)(collection, data)
    if truth is not None:
        true = truth.reindex(state=shown).to_dataset(name="truth")
        collection.map(curve, "truth", data=true, **TRUTH)
        legend["truth"] = TRUTH
    if record is not None and set(shown) & set(record["state"].values):
        seen = record.reindex(state=shown).to_dataset(name="data")
        collection.map(points, "data", data=seen, diameter=4, **DATA)
        legend["data"] = legend_style(DATA)
    label_axes(collection, draws["time"])
    add_legend(collection, legend)
    return collection


def _record(
    idata: xr.DataTree, name: str, observables: Mapping[str, str] | None, states: Sequence[str]
) -> xr.DataArray | None:
    """Return the observations of each measured state, over time and state."""
    record = data_of(idata, name)
    if record is None:
        if observables:
            raise ModelError(f"observables needs observed_data[{name!r}] in idata, got none")
        return None
    there = [str(observable) for observable in record["observable"].values]
    if observables is None:
        observables = {state: state for state in states if state in there}
    check_names("observables: its states", observables, states)
    check_names("observables: its values", observables.values(), there)
    measured = record.sel(observable=list(observables.values()))
    return measured.rename(observable="state").assign_coords(state=list(observables))
