"""Plots over time of states, with observations and the truth (thesis, Fig. 12), and simulations."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection

from ..errors import ModelError
from ..former_names import former_names
from ..system.checks import check_count
from .finite import ribbons, tick_values
from .over_time import (
    DATA,
    DRAWS,
    TRUTH,
    connected,
    over_draws,
    picture_over_time,
    points_of,
    spread_of,
)
from .picture import Mark
from .results import (
    SAMPLE_DIMS,
    axis_label,
    data_of,
    functions_of,
    group_of,
    measured_by,
    names_of,
    observations_of,
    rows_of,
    rows_of_simulation,
    select_names,
    time_label,
    transformed,
    truth_of,
    variable_of,
)
from .shapes import FEW, band, curve, paths, points

PATHS = {"color": "C0", "alpha": 0.4, "width": 0.6}
DOTS = {"color": "C0", "alpha": 0.4, "diameter": 2}
RIBBON = {**DRAWS, "alpha": 0.5}


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
    groups = ("smoothed_states", "filtered_states") if group is None else (group,)
    group, results = group_of(idata, *groups)
    name = variable_of(results, var_name, "_states")
    variable = results[f"{name}_states"]
    rows = rows_of(idata, results, f"{name}_states", name).choose("records", records)
    draws = rows.over_time(variable).rename({variable.dims[-1]: "state"})
    record = data_of(idata, name, rows)
    if record is None and observables:
        raise ModelError(f"observables needs observed_data[{name!r}] in idata, got none")
    measured = {} if record is None else measured_by(observables, draws, record)
    all_states = names_of(draws, "state")
    shown = select_names("states", states, all_states)
    functions = functions_of(
        transform, all_states, () if record is None else names_of(record, "observable")
    )
    if observables is None:  # what is a state is drawn as that state
        of_state = {one: functions[state] for state, one in measured.items() if state in functions}
        functions = of_state | dict(functions)

    at_observations = results.attrs.get("at") == "observations"
    data = transformed(draws.sel(state=shown), "state", functions).to_dataset(name="states")
    finite, marks = ribbons(data["states"]), []
    quantiles = over_draws(data)
    if finite is not None:
        edges = connected(finite.reindex(state=shown).to_dataset(name="states"))
        quantiles = quantiles.where(~data["state"].isin(finite["state"]))
        marks = [
            Mark(band, "probability", edges, RIBBON, "probability"),
            Mark(tick_values, None, edges),
        ]
    # Bands below the points, lines above them.
    below, lines = spread_of(quantiles, as_bars=at_observations and data.sizes["time"] <= FEW)
    marks += below
    if n_draws:
        are_paths = group != "filtered_states" and not at_observations
        draw, style = (paths, PATHS) if are_paths else (points, DOTS)
        marks.append(Mark(draw, "draws", _thinned(data, n_draws), style, "draws"))
    if record is not None:
        data_points = observations_of(transformed(record, "observable", functions), measured, shown)
        marks.append(points_of(data_points, "data", DATA, "data"))
    if truth is not None:
        true = truth_of(truth, "states", "state", draws, rows)
        begin, end = draws["time"].values[[0, -1]]
        true = true.where((true["time"] >= begin) & (true["time"] <= end), drop=True)
        true = transformed(true, "state", functions).reindex(state=shown)
        lines.append(Mark(curve, "truth", connected(true.to_dataset(name="truth")), TRUTH, "truth"))
    return picture_over_time(
        data,
        [*marks, *lines],
        [axis_label(state, functions, draws) for state in shown],
        x=time_label(draws, record),
        backend=backend,
        pc_kwargs=pc_kwargs,
    )


def _thinned(draws: xr.Dataset, n_draws: int) -> xr.Dataset:
    """Return `n_draws` of the draws that are not all NaN, evenly, along the dimension "path"."""
    stacked = draws.stack(path=SAMPLE_DIMS).drop_vars(["path", *SAMPLE_DIMS])
    stacked = stacked.dropna("path", how="all")
    n_draws = min(n_draws, stacked.sizes["path"])
    return stacked.isel(path=np.linspace(0, stacked.sizes["path"] - 1, n_draws).astype(int))


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
    path, record = (
        rows_of_simulation(simulated, name).choose("records", records).over_time(simulated[name])
        for name in ("states", "observations")
    )
    all_states, seen = names_of(path, "state"), names_of(record, "observable")
    measured = measured_by(observables, path, record)
    panels = select_names("states", states, all_states)
    if states is None:  # an observable that measures no state has a panel
        alone = [one for one in seen if one not in measured.values() and one not in all_states]
        measured |= {one: one for one in alone}
        panels += alone
    functions = functions_of(transform, all_states, seen)
    drawn = transformed(path, "state", functions).reindex(state=panels).to_dataset(name="path")
    data = observations_of(transformed(record, "observable", functions), measured, panels)
    return picture_over_time(
        drawn,
        [
            points_of(data, "data", DATA, "data"),
            Mark(curve, "path", connected(drawn), {**DRAWS, "width": 1.5}, "path"),
        ],
        [axis_label(one, functions, path, record) for one in panels],
        x=time_label(path, record),
        backend=backend,
        pc_kwargs=pc_kwargs,
    )
