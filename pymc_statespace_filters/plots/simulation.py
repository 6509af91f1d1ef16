"""What `simulate` returns, over time: the path of the states, and the observations."""

from collections.abc import Mapping, Sequence
from typing import Any

import xarray as xr
from arviz_plots import PlotCollection

from ..errors import ModelError
from .axes import label_axes, time_label
from .canvas import curve
from .legend import add_legend
from .marks import DRAWS, canvas_over_time, draw_data
from .panels import facets_of_simulation
from .results import measured_by, observations_of, select_names
from .transforms import axis_label, functions_of, of_record, transformed

PATH = {**DRAWS, "width": 1.5}


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
    measured = measured_by(observables, all_states, seen)
    shown = select_names("states", states, all_states)
    if states is None:  # an observable that measures no state has a panel
        alone = [one for one in seen if one not in measured.values() and one not in all_states]
        measured |= {one: one for one in alone}
        panels = [*shown, *alone]
    else:
        panels = shown

    functions = functions_of(transform, all_states, seen)
    path = transformed(path, "state", functions)
    record = transformed(record, "observable", of_record(transform, functions))
    data = path.reindex(state=panels).to_dataset(name="path")
    collection = canvas_over_time(
        data, "state", facets.panels_in_line, backend=backend, pc_kwargs=pc_kwargs
    )
    legend = {}
    if set(measured) & set(panels):
        legend = draw_data(collection, observations_of(record, measured, panels))
    collection.map(curve, "path", **PATH)
    labels = [axis_label(one, functions, path, record) for one in panels]
    label_axes(collection, labels, time_label(path, record))
    add_legend(collection, {"path": PATH} | legend)
    return collection
