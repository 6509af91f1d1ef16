"""Plots over time of states, with observations and the truth (thesis, Fig. 12), and simulations."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import xarray as xr
from arviz_plots import PlotCollection

from ..errors import ModelError
from ..former_names import former_names
from ..system.checks import check_count
from .canvas import curve, label_axes, time_label
from .finite import draw_ribbons, is_continuous, ribbons
from .legend import add_legend
from .marks import (
    DOTS,
    DRAWS,
    FEW,
    PATHS,
    TRUTH,
    Functions,
    axis_label,
    canvas_over_time,
    draw_bands,
    draw_bars,
    draw_data,
    draw_median,
    functions_of,
    over_draws,
    paths,
    points,
    thin_draws,
    transformed,
)
from .panels import Facets, facets_of_simulation, several_records
from .results import (
    data_of,
    measured_by,
    name_of_states,
    observations_of,
    select_names,
    sensors_of,
    states_of,
    truth_of,
)

PATH = {**DRAWS, "width": 1.5}


@former_names
def plot_states(
    idata: xr.DataTree | xr.Dataset,
    *,
    group: str | None = None,
    var_name: str | None = None,
    records: Any = None,
    states: str | Sequence[str] | None = None,
    observables: Mapping[str, str] | None = None,
    truth: Any = None,
    n_draws: int = 0,
    transform: Callable[[Any], Any] | Mapping[str, Callable[[Any], Any]] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> PlotCollection:
    """Plot states over time with their uncertainty, one panel per state.

    Bands contain 50 % and 90 % of the draws, which include the uncertainty of the parameters; the
    line is their median. States at no more than 200 observation times are shown as bars. Failed
    draws are ignored; where all failed there is a gap. A state that takes a few values, as a
    regime, has a ribbon along each value instead, as thick as its probability.

    The path of `simulate` is shown as a line, and each observable that is no state in a panel of
    its own.

    Of a panel, each record has panels of its own.

    Axes have units if the results have them in ``attrs["units"]``: of the variable or of its last
    coordinate, as a text, a list or a mapping from names; and of the coordinate of time.

    Parameters
    ----------
    idata : xarray.DataTree or xarray.Dataset
        Result of `filtered_states` or `smoothed_states`; or of `simulate`.
    group : {"smoothed_states", "filtered_states"}, optional
        By default the smoothed states if there are any.
    var_name : str, optional
        Name of the StateSpace variable, if there are several.
    records : label or sequence of labels, optional
        The records of a panel to show; by default the first twelve.
    states : str or sequence of str, optional
        Names of the states to show; all by default.
    observables : mapping of str to str, optional
        Maps a state to the observable that measures it; its observations are shown in the panel as
        points. By default each observable with the name of a state, or whose sensor is that state
        itself, as in ``observation=lambda x: [x[0]]``.
    truth : array_like or xarray.DataArray or xarray.Dataset, optional
        The result of `simulate`; a DataArray with a dimension ``state`` and another whose
        coordinate is time; or an array of shape (number of times, number of states). It is shown
        within the range of times of the states. Of a panel, the result of `simulate`.
    n_draws : int
        Number of draws to show beside the bands: as lines for smoothed states at every step, as
        points for filtered states and for states at observation times only.
    transform : callable or mapping of str to callable, optional
        Function of an array that is applied to the states, the truth, and the observables that are
        states by default before they are drawn: ``numpy.exp`` shows the abundance if the state is
        its logarithm. Others, such as those of ``observables``, are drawn as they are. A mapping
        from names of states and observables gives each its function.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``: ``col_wrap=2`` gives two columns of panels.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``band_90``, ``band_50`` and ``median`` (or ``bar_90`` and ``bar_50``), ``data``,
        ``truth``, ``draws``, and ``probability`` of states that take a few values, along ``state``;
        of a simulation ``path`` and ``data``.

    Raises
    ------
    ModelError
        If there are no such states, or a name, the truth or the transform does not match them.

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
    if isinstance(idata, xr.Dataset):
        refuse_without_draws(group=group, var_name=var_name, truth=truth, n_draws=n_draws or None)
        return draw_simulation(idata, records, states, observables, transform, backend, pc_kwargs)
    group, name = name_of_states(idata, group, var_name)
    facets = several_records(idata, group, name, f"{name}_states", records)
    idata, truth, states = facets.idata, facets.truth(truth, "states"), facets.names(states)
    observables = facets.mapping(observables, to_names=True)
    transform = facets.mapping(transform)
    _, draws, at_observations, are_paths = states_of(idata, group, name)
    all_states = [str(state) for state in draws["state"].values]
    shown = select_names("states", states, all_states)
    record, measured = _record(idata, name, observables, draws, facets)
    seen = [] if record is None else [str(one) for one in record["observable"].values]
    functions = functions_of(transform, all_states, seen)
    if observables is None:  # what is a state is drawn as that state
        of_state = {one: functions[state] for state, one in measured.items() if state in functions}
        functions = of_state | dict(functions)
    true = None if truth is None else _truth(truth, draws, functions, shown)

    data = transformed(draws.sel(state=shown), "state", functions).to_dataset(name="states")
    collection = canvas_over_time(
        data, "state", facets.panels_in_line, backend=backend, pc_kwargs=pc_kwargs
    )
    # Bands below the points, lines above them.
    as_bars = at_observations and data.sizes["time"] <= FEW
    quantiles = over_draws(data) if as_bars else facets.connected(over_draws(data))
    edges = ribbons(data["states"])
    bands: dict[str, Any] = {}
    if edges is not None:
        quantiles = quantiles.where(is_continuous(edges))
        bands = draw_ribbons(collection, facets.connected(edges))
    if has_bands := bool(edges is None or is_continuous(edges).any()):
        bands |= (draw_bars if as_bars else draw_bands)(collection, quantiles)
    if n_draws:
        mark, style = (paths, PATHS) if are_paths else (points, DOTS)
        collection.map(mark, "draws", data=thin_draws(data, n_draws), **style)
    legend = {}
    if record is not None and set(shown) & set(measured):
        record = transformed(record, "observable", functions)
        legend = draw_data(collection, observations_of(record, measured, shown))
    lines = draw_median(collection, quantiles) if has_bands and not as_bars else {}
    if true is not None:
        collection.map(curve, "truth", data=true.to_dataset(name="truth"), **TRUTH)
        legend = {"truth": TRUTH} | legend
    labels = [axis_label(state, functions, draws) for state in shown]
    label_axes(collection, labels, time_label(draws, record), facets.records_of(shown))
    add_legend(collection, lines | bands | legend)
    return collection


def _truth(
    truth: Any, draws: xr.DataArray, functions: Functions, shown: Sequence[str]
) -> xr.DataArray:
    """Return the true states within the times of the draws."""
    all_states = [str(state) for state in draws["state"].values]
    true = truth_of(truth, "states", "state", all_states, draws["time"].values)
    begin, end = draws["time"].values[[0, -1]]
    true = true.where((true["time"] >= begin) & (true["time"] <= end), drop=True)
    return transformed(true, "state", functions).reindex(state=shown)


def _record(
    idata: xr.DataTree,
    name: str,
    observables: Mapping[str, str] | None,
    draws: xr.DataArray,
    facets: Facets,
) -> tuple[xr.DataArray | None, dict[str, str]]:
    """Return the observations if idata has them, and the observable of each measured state."""
    record = data_of(idata, name)
    if record is None:
        if observables:
            raise ModelError(f"observables needs observed_data[{name!r}] in idata, got none")
        return None, {}
    states, there = ([str(one) for one in a[a.dims[-1]].values] for a in (draws, record))
    sensors = facets.mapping(sensors_of(draws), to_names=True)
    return record, measured_by(observables, states, there, sensors)


def refuse_without_draws(**given: Any) -> None:
    """Raise a `ModelError` if an argument is given that only draws of states have."""
    if wrong := [name for name, value in given.items() if value is not None]:
        raise ModelError(f"{wrong[0]} is for draws of states, got it with a result of simulate")


def draw_simulation(
    simulated: xr.Dataset,
    records: Any,
    states: str | Sequence[str] | None,
    observables: Mapping[str, str] | None,
    transform: Any,
    backend: str | None,
    pc_kwargs: Mapping[str, Any],
) -> PlotCollection:
    """Draw a result of `simulate`, with one panel per state and per observable that is none."""
    if not {"states", "observations"} <= set(simulated):
        raise ModelError(
            "idata must be a DataTree of draws or a result of simulate, got a Dataset of "
            f"{[str(name) for name in simulated]}"
        )
    facets = facets_of_simulation(simulated, records)
    path, record = (facets.simulated(simulated, name) for name in ("states", "observations"))
    states, transform = facets.names(states), facets.mapping(transform)
    observables = facets.mapping(observables, to_names=True)
    all_states, seen = ([str(n) for n in a[a.dims[-1]].values] for a in (path, record))
    measured = measured_by(observables, all_states, seen, {})
    shown = select_names("states", states, all_states)
    if states is None:  # an observable that measures no state has a panel
        alone = [one for one in seen if one not in measured.values() and one not in all_states]
        measured |= {one: one for one in alone}
        panels = [*shown, *alone]
    else:
        panels = shown

    functions = functions_of(transform, all_states, seen)
    path = transformed(path, "state", functions)
    record = transformed(record, "observable", functions)
    data = path.reindex(state=panels).to_dataset(name="path")
    collection = canvas_over_time(
        data, "state", facets.panels_in_line, backend=backend, pc_kwargs=pc_kwargs
    )
    legend = {}
    if set(measured) & set(panels):
        legend = draw_data(collection, observations_of(record, measured, panels))
    collection.map(curve, "path", **PATH)
    labels = [axis_label(one, functions, path, record) for one in panels]
    label_axes(collection, labels, time_label(path, record), facets.records_of(panels))
    add_legend(collection, {"path": PATH} | legend)
    return collection
