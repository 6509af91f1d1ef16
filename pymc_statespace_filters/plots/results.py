"""What plots read: groups of draws over time, by record of a panel, observations and the truth."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from ..errors import ModelError
from .picture import with_unit

SAMPLE_DIMS = ("chain", "draw")
MOST_RECORDS = 12  # that a figure shows unless others are chosen
CALLS = {  # that make the groups
    "smoothed_states": "psf.smoothed_states(idata, model)",
    "filtered_states": "psf.filtered_states(idata, model)",
    "predictions": "psf.forecast(idata, model, n_steps=...)",
    "free_run": "psf.free_run(idata, model)",
    "filter_diagnostics": "psf.filter_diagnostics(idata, model)",
}

Functions = Mapping[str, Callable[[Any], Any]]


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


class Rows(NamedTuple):
    """The time of each row of a variable, and of a panel its record; and the records to show."""

    times: xr.DataArray
    records: np.ndarray | None = None
    shown: Sequence[Any] = ()

    def choose(self, argument: str, given: Any) -> "Rows":
        """Choose the records of a panel, a label or several; of "records" by default twelve."""
        if self.records is None:
            if given is not None:
                raise ModelError(f"{argument} must be None without a panel, got {given!r}")
            return self
        labels = list(dict.fromkeys(self.records.tolist()))
        if given is None and argument == "records":
            return self._replace(shown=labels[:MOST_RECORDS])
        is_list = isinstance(given, Iterable) and not isinstance(given, str)
        shown = list(given) if is_list else [given]
        if not shown or any(label not in labels for label in shown):
            raise ModelError(f"{argument} must be among the labels {labels}, got {given!r}")
        return self._replace(shown=shown)

    def over_time[T: (xr.DataArray, xr.Dataset)](self, found: T) -> T:
        """Give results of rows the dimension "time", and of a panel "record" before all others.

        Where a record has no row at the time of another, there is NaN.
        """
        (dim,) = self.times.dims
        found = found.drop_vars([name for name, c in found.coords.items() if dim in c.dims])
        times = ("time", self.times.values, self.times.attrs)
        found = found.rename({dim: "time"}).assign_coords(time=times)
        if self.records is None:
            return found
        parts = [found.isel(time=self.records == label) for label in self.shown]
        index = xr.DataArray(list(self.shown), dims="record", name="record")
        return xr.concat(parts, index, join="outer", combine_attrs="override")


def rows_of(
    idata: xr.DataTree, found: xr.Dataset, variable: str, name: str, labels: Sequence[Any] = ()
) -> Rows:
    """Return the rows of an array of a group, along its last dimension but one.

    The groups of PyMC have no records and times of a panel, but constant data have them, where
    `labels` that are texts have numbers.
    """
    dim = found[variable].dims[-2]
    if f"{name}_panel" in found.coords:
        return Rows(found[f"{name}_time"], found[f"{name}_panel"].values)
    known = idata["constant_data"].to_dataset() if "constant_data" in idata.children else {}
    if f"{name}_panel" not in known:
        return Rows(found[dim])
    records, times = known[f"{name}_panel"].values, known[f"{name}_time"]
    if labels and isinstance(labels[0], str):
        records = np.array(labels)[records]
    return Rows(times.rename({times.dims[0]: dim}), records)


def rows_of_simulation(simulated: xr.Dataset, variable: str) -> Rows:
    """Return the rows of "states" or "observations" of a result of `simulate`."""
    prefix = {"states": "", "observations": "obs_"}[variable]
    records = simulated.coords.get(f"{prefix}record")
    return Rows(simulated[f"{prefix}time"], None if records is None else records.values)


def data_of(idata: xr.DataTree, name: str, rows: Rows) -> xr.DataArray | None:
    """Return the observations over time and "observable" if idata has them, of the same records."""
    if "observed_data" not in idata.children:
        return None
    data = idata["observed_data"].to_dataset()
    if name not in data:
        return None
    labels = () if rows.records is None else list(dict.fromkeys(rows.records.tolist()))
    own = rows_of(idata, data, name, name, labels)
    if (own.records is None) != (rows.records is None):
        return None
    found = own._replace(shown=rows.shown).over_time(data[name])
    return found.rename({data[name].dims[-1]: "observable"})


def diagnostics_of(
    idata: xr.DataTree, variable: str, var_name: str | None, record: Any
) -> tuple[xr.Dataset, xr.DataArray | None]:
    """Return the filter diagnostics of a variable and its observations, of one record of a panel.

    They are over "time" and "observable", without the observables that have no ``variable``.
    """
    _, results = group_of(idata, "filter_diagnostics")
    name = variable_of(results, var_name, f"_{variable}")
    rows = rows_of(idata, results, f"{name}_{variable}", name).choose("record", record)
    data = data_of(idata, name, rows)
    observable = results[f"{name}_{variable}"].dims[-1]
    results = results[[one for one in results if str(one).startswith(f"{name}_")]]
    if rows.records is not None:
        of_records = {f"{name}_record": rows.shown[0]} if f"{name}_record" in results.dims else {}
        results = results.sel(of_records, drop=True)
    found = rows.over_time(results)
    found = found.rename(
        {one: str(one).removeprefix(f"{name}_") for one in found} | {observable: "observable"}
    )
    if rows.records is not None:
        found = found.isel(record=0, drop=True)
        data = None if data is None else data.isel(record=0, drop=True)
    seen = found[variable].notnull().any("time")
    if not seen.any():
        raise ModelError("there must be an observation to compare with its prediction, got none")
    return found.isel(observable=seen.values), data


def select_names(argument: str, names: Any, available: Sequence[str]) -> list[str]:
    """Return `names` as a list, all available ones if None, checked to be available."""
    if names is None:
        return list(available)
    names = [names] if isinstance(names, str) else list(names)
    check_names(argument, names, available)
    return names


def check_names(argument: str, names: Iterable[str], available: Sequence[str]) -> None:
    """Raise a `ModelError` for names that are not available."""
    unknown = [name for name in names if name not in available]
    if unknown:
        raise ModelError(f"{argument} must be among {list(available)}, got {unknown}")


def names_of(array: xr.DataArray, along: str) -> list[str]:
    """The names along a dimension."""
    return [str(name) for name in array[along].values]


def measured_by(
    observables: Mapping[str, str] | None, path: xr.DataArray, record: xr.DataArray
) -> dict[str, str]:
    """Return the observable of each measured state: given, of its name, or else by its sensor.

    The sensors are known from the equations behind draws.
    """
    states, there = names_of(path, "state"), names_of(record, "observable")
    if observables is None:
        sensors = json.loads(path.attrs.get("observables", "{}"))
        of_name = {state: state for state in states if state in there}
        return {state: one for state, one in sensors.items() if one in there} | of_name
    check_names("observables: its states", observables, states)
    check_names("observables: its values", observables.values(), there)
    return dict(observables)


def observations_of(
    record: xr.DataArray, measured: Mapping[str, str], states: Sequence[str]
) -> xr.DataArray:
    """Return the observations of each of `states`, over time and state; NaN if not measured."""
    there = record.sel(observable=list(measured.values()))
    there = there.rename(observable="state").assign_coords(state=list(measured))
    return there.reindex(state=list(states))


def truth_of(
    truth: Any, simulated: str, along: str, draws: xr.DataArray, rows: Rows
) -> xr.DataArray:
    """Return the user's `truth` with dimensions "time" and `along` ("state" or "observable").

    It is a result of `simulate`, of which the variable `simulated` is taken; an array with the
    dimension `along` and another whose coordinate is time; or an array of shape (times, names),
    those of the draws. Of a panel it is a result of `simulate`.
    """
    if rows.records is not None:
        if not (isinstance(truth, xr.Dataset) and "record" in truth.coords):
            raise ModelError("truth of a panel must be the result of psf.simulate(..., panel=...)")
        own = rows_of_simulation(truth, simulated)._replace(shown=rows.shown)
        return own.over_time(truth[simulated])
    names = names_of(draws, along)
    if isinstance(truth, xr.Dataset):
        if simulated not in truth:
            raise ModelError(f"truth must have the variable {simulated!r}, got {truth}")
        truth = truth[simulated]
    if not isinstance(truth, xr.DataArray):
        values = np.asarray(truth, dtype=float)
        if values.ndim == 1 and len(names) == 1:
            values = values[:, None]
        expected = (draws.sizes["time"], len(names))
        if values.shape != expected:
            raise ModelError(
                f"truth must have shape {expected}, one row per plotted time, got shape "
                f"{values.shape}: for other times give a DataArray with times as coordinate"
            )
        return xr.DataArray(values, coords=[("time", draws["time"].values), (along, names)])
    if along not in truth.dims and len(names) == 1:
        truth = truth.expand_dims({along: names})
    others = [dim for dim in truth.dims if dim != along]
    if along not in truth.coords or len(others) != 1:
        raise ModelError(
            f"truth must have the dimension {along!r} with names and one of time, got dimensions "
            f"{truth.dims}"
        )
    shared = [name for name in names if name in truth[along].values]
    if not shared:
        raise ModelError(f"truth must have some of {names}, got {names_of(truth, along)}")
    of_rows = [c for c in truth.coords.values() if c.dims == tuple(others)]
    times = next((c for c in of_rows if str(c.name).endswith("time")), truth[others[0]])
    return Rows(times).over_time(truth.sel({along: shared})).transpose("time", along)


def functions_of(transform: Any, names: Sequence[str], others: Sequence[str] = ()) -> Functions:
    """Return the function of each name: one function for all `names`, or a mapping.

    A mapping may name the `others` too.
    """
    if transform is None:
        return {}
    if callable(transform):
        return dict.fromkeys(names, transform)
    if isinstance(transform, Mapping) and all(callable(one) for one in transform.values()):
        check_names("transform", transform, list(dict.fromkeys([*names, *others])))
        return dict(transform)
    raise ModelError(
        "transform must be a function of an array, such as numpy.exp, or a mapping of names to "
        f"such functions, got {transform!r}"
    )


def transformed(array: xr.DataArray, along: str, functions: Functions) -> xr.DataArray:
    """Apply to each entry along the dimension `along` its function, if it has one."""

    def applied(one: xr.DataArray) -> xr.DataArray:
        name = str(one[along].item())
        values = one.values.astype(float)
        result = np.asarray(functions.get(name, lambda same: same)(values))
        if result.shape != values.shape:
            raise ModelError(
                "transform must return an array of the shape it is given, "
                f"{values.shape} of {name!r}, got shape {result.shape}"
            )
        return one.copy(data=result)

    if not set(names_of(array, along)) & set(functions):
        return array
    parts = [applied(array.isel({along: i})) for i in range(array.sizes[along])]
    return xr.concat(parts, along).transpose(*array.dims)


def axis_label(name: str, functions: Functions, *arrays: xr.DataArray | None) -> str:
    """Return "exp(name)" if that is drawn, else the name with its unit in the `arrays`."""
    if name not in functions:
        return with_unit(name, unit_of(name, *arrays))
    of_function = getattr(functions[name], "__name__", "")
    return f"{of_function}({name})" if of_function.isidentifier() else name


def unit_of(name: str, *arrays: xr.DataArray | None) -> str | None:
    """Return the unit of a state or observable, from the first array that tells it.

    It is ``attrs["units"]`` of the array or of its last coordinate: a text for all names, a list in
    their order, or a mapping.
    """
    for array in arrays:
        if array is None or name not in array[array.dims[-1]].values:
            continue
        names = array[array.dims[-1]]
        for units in (array.attrs.get("units"), names.attrs.get("units")):
            if isinstance(units, str):
                return units
            of_names = units or {}
            if not isinstance(of_names, Mapping):
                of_names = dict(zip(names.values, of_names, strict=False))
            if name in of_names:
                return str(of_names[name])
    return None


def time_label(*arrays: xr.DataArray | None) -> str:
    """Return the label of the time axis, with the unit of the first array that has one."""
    units = (array["time"].attrs.get("units") for array in arrays if array is not None)
    return with_unit("time", next((str(unit) for unit in units if unit is not None), None))
