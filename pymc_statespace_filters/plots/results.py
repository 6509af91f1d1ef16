"""Read and check the inputs of plots of states: groups, variables, observations, the truth."""

import json
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from ..errors import ModelError

SAMPLE_DIMS = ("chain", "draw")
CALLS = {  # that make the groups
    "smoothed_states": "psf.smoothed_states(idata, model)",
    "filtered_states": "psf.filtered_states(idata, model)",
    "predictions": "psf.forecast(idata, model, n_steps=...)",
    "free_run": "psf.free_run(idata, model)",
    "filter_diagnostics": "psf.filter_diagnostics(idata, model)",
}


def group_of(idata: Any, *groups: str) -> tuple[str, xr.Dataset]:
    """Return name and contents of the first existing group, or raise with the call to make one."""
    if not isinstance(idata, xr.DataTree):
        raise ModelError(f"idata must be a DataTree of draws, got {type(idata).__name__}")
    for group in groups:
        if group in idata.children:
            return group, idata[group].to_dataset()
    make = f": run {CALLS[groups[0]]} first" if groups[0] in CALLS else f", only {list(idata)}"
    raise ModelError(f"idata has no group {groups[0]!r}{make}")


def variable_of(dataset: xr.Dataset, var_name: str | None, suffix: str = "") -> str:
    """Return the name of the StateSpace variable in a group, given or the only one."""
    found = [str(name).removesuffix(suffix) for name in dataset if str(name).endswith(suffix)]
    if var_name is None and len(found) == 1:
        return found[0]
    if var_name is None or var_name not in found:
        raise ModelError(f"var_name must be one of {found}, got {var_name!r}")
    return var_name


def rename_last_dims(array: xr.DataArray, *names: str) -> xr.DataArray:
    """Rename the last dimensions of `array`, whose names depend on the model."""
    return array.rename(dict(zip(array.dims[-len(names) :], names, strict=True)))


def data_of(idata: xr.DataTree, name: str) -> xr.DataArray | None:
    """Return the observations of a variable if idata has them, over "time" and "observable"."""
    if "observed_data" not in idata.children:
        return None
    record = idata["observed_data"].to_dataset().get(name)
    return None if record is None else rename_last_dims(record, "time", "observable")


class States(NamedTuple):
    """The drawn states of a StateSpace variable."""

    name: str
    draws: xr.DataArray  # dimensions (chain, draw, time, state)
    at_observations: bool  # at observation times only
    are_paths: bool  # joint paths at every step, which may be drawn as lines


def name_of_states(idata: Any, group: str | None, var_name: str | None) -> tuple[str, str]:
    """Return the group, by default the smoothed states if there are any, and the variable."""
    groups = ("smoothed_states", "filtered_states") if group is None else (group,)
    group, results = group_of(idata, *groups)
    return group, variable_of(results, var_name, "_states")


def states_of(idata: Any, group: str | None, var_name: str | None) -> States:
    """Read the states of a group, by default the smoothed ones if there are any."""
    group, name = name_of_states(idata, group, var_name)
    results = idata[group].to_dataset()
    draws = rename_last_dims(results[f"{name}_states"], "time", "state")
    at_observations = results.attrs.get("at") == "observations"
    return States(name, draws, at_observations, group != "filtered_states" and not at_observations)


def select_names(argument: str, names: Any, available: Sequence[str]) -> list[str]:
    """Return `names` as a list, all available ones if None, checked to be available."""
    if names is None:
        return list(available)
    names = [names] if isinstance(names, str) else list(names)
    check_names(argument, names, available)
    return names


def measured_by(
    observables: Mapping[str, str] | None,
    states: Sequence[str],
    available: Sequence[str],
    sensors: Mapping[str, str],
) -> dict[str, str]:
    """Return the observable of each measured state: given, of its name, or else by the sensors."""
    if observables is None:
        of_name = {state: state for state in states if state in available}
        return {state: one for state, one in sensors.items() if one in available} | of_name
    check_names("observables: its states", observables, states)
    check_names("observables: its values", observables.values(), available)
    return dict(observables)


def sensors_of(draws: xr.DataArray) -> dict[str, str]:
    """The observable that measures a state, where the equations of the draws tell."""
    return dict(json.loads(draws.attrs.get("observables", "{}")))


def observations_of(
    record: xr.DataArray, measured: Mapping[str, str], states: Sequence[str]
) -> xr.DataArray:
    """Return the observations of each of `states`, over time and state; NaN if not measured."""
    there = record.sel(observable=list(measured.values()))
    there = there.rename(observable="state").assign_coords(state=list(measured))
    return there.reindex(state=list(states))


def seen_observables(residual: xr.DataArray) -> np.ndarray:
    """Whether each observable has a residual, of which there must be one."""
    seen = residual.notnull().values.any(axis=0)
    if not seen.any():
        raise ModelError("there must be an observation to compare with its prediction, got none")
    return seen


def check_names(argument: str, names: Iterable[str], available: Sequence[str]) -> None:
    """Raise a `ModelError` for names that are not available."""
    unknown = [name for name in names if name not in available]
    if unknown:
        raise ModelError(f"{argument} must be among {list(available)}, got {unknown}")


def truth_of(
    truth: Any, simulated: str, along: str, names: Sequence[str], times: np.ndarray
) -> xr.DataArray:
    """Return the user's `truth` with dimensions "time" and `along` ("state" or "observable").

    It is a result of `simulate`, of which the variable `simulated` is taken; an array with the
    dimension `along` and another whose coordinate is time; or an array of shape (times, names),
    those of the results.
    """
    if isinstance(truth, xr.Dataset):
        if simulated not in truth:
            raise ModelError(f"truth must have the variable {simulated!r}, got {truth}")
        truth = truth[simulated]
    if not isinstance(truth, xr.DataArray):
        return _rows(np.asarray(truth, dtype=float), along, names, times)
    if along not in truth.dims and len(names) == 1:
        truth = truth.expand_dims({along: list(names)})
    others = [dim for dim in truth.dims if dim != along]
    if along not in truth.coords or len(others) != 1:
        raise ModelError(
            f"truth must have the dimension {along!r} with names and one of time, got dimensions "
            f"{truth.dims}"
        )
    shared = [name for name in names if name in truth[along].values]
    if not shared:
        raise ModelError(
            f"truth must have some of {list(names)}, got {along}s {list(truth[along].values)}"
        )
    return _with_times(truth.sel({along: shared}), others[0]).transpose("time", along)


def _rows(values: np.ndarray, along: str, names: Sequence[str], times: np.ndarray) -> xr.DataArray:
    if values.ndim == 1 and len(names) == 1:
        values = values[:, None]
    expected = (times.size, len(names))
    if values.shape != expected:
        raise ModelError(
            f"truth must have shape {expected}, one row per plotted time, got shape "
            f"{values.shape}: for other times give a DataArray with times as coordinate"
        )
    return xr.DataArray(values, coords=[("time", times), (along, list(names))])


def _with_times(truth: xr.DataArray, dim: Hashable) -> xr.DataArray:
    """Rename `dim` to "time", with the times as its only coordinate."""
    of_dim = [
        name
        for name, coordinate in truth.coords.items()
        if coordinate.dims == (dim,) and str(name).endswith("time")
    ]
    times = truth[of_dim[0] if of_dim else dim].values
    values = truth.drop_vars([name for name, c in truth.coords.items() if dim in c.dims])
    return values.rename({dim: "time"}).assign_coords(time=times)
