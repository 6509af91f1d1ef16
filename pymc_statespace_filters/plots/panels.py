"""Records of a panel as plots take them: each as results of a variable without a panel."""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from ..errors import ModelError
from .canvas import unit_of
from .results import group_of

MOST_RECORDS = 12  # that a figure shows unless others are chosen
RECORDS_IN_LINE = 3


def one_record(idata: xr.DataTree, group: str, name: str, record: Any) -> xr.DataTree:
    """Return a group and the data of one record of a panel, over its own times.

    A variable without a panel is left as it is.
    """
    _, results = group_of(idata, group)
    if (labels := _labels_for(results, name, "record", record)) is None:
        return idata
    if record not in labels:
        raise ModelError(f"record must be a label of the panel, one of {labels}, got {record!r}")
    found = {group: _rows_of(results, name, record)}
    if (data := _data_of(idata, name, labels)) is not None:
        found["observed_data"] = _rows_of(data, name, record)
    if "sample_stats" in idata.children:
        found["sample_stats"] = idata["sample_stats"].to_dataset()
    return xr.DataTree.from_dict(found)


def with_rows_of_panel(
    idata: xr.DataTree, group: str, name: str, labels: Sequence[Any] | None
) -> xr.DataTree:
    """Give a group of PyMC's the record and the time of each row, which constant data have.

    ``labels`` are those of the records, if they are known. A variable without a panel is left as it
    is.
    """
    if "constant_data" not in idata.children or f"{name}_panel" in idata[group].coords:
        return idata
    known = idata["constant_data"].to_dataset()
    if f"{name}_panel" not in known:
        return idata
    results = idata[group].to_dataset()
    coords = _coords_of_rows(known, name, labels, results[name].dims[-2])
    return xr.DataTree.from_dict(
        {child: node.to_dataset() for child, node in idata.children.items()}
        | {group: results.assign_coords(coords)}
    )


class Facets(NamedTuple):
    """Several records of a panel as one, whose names are "record: name"; times are those of all.

    Where a record has no row, there is NaN. A variable without a panel is left as it is: it has no
    ``labels``.
    """

    idata: xr.DataTree
    labels: list[Any]
    panels_in_line: int

    def names(self, chosen: str | Sequence[str] | None) -> list[str] | str | Sequence[str] | None:
        """The chosen names of every record, one record after the other."""
        if not self.labels or chosen is None:
            return chosen
        names = [chosen] if isinstance(chosen, str) else chosen
        return [named(label, name) for label in self.labels for name in names]

    def mapping(self, given: Any, *, to_names: bool = False) -> Any:
        """A user's mapping from names, with an entry for each record; others as they are."""
        if not self.labels or not isinstance(given, Mapping):
            return given
        return {
            named(label, name): named(label, value) if to_names else value
            for label in self.labels
            for name, value in given.items()
        }

    def truth(self, truth: Any, simulated: str) -> Any:
        """A result of `simulate` with a panel, with the names of every record."""
        if not self.labels or truth is None:
            return truth
        if not (isinstance(truth, xr.Dataset) and "record" in truth.coords):
            raise ModelError("truth of a panel must be the result of psf.simulate(..., panel=...)")
        return self.simulated(truth, simulated)

    def simulated(self, results: xr.Dataset, variable: str) -> xr.DataArray:
        """States or observations of `simulate` over time, with the names of every record."""
        prefix = {"states": "", "observations": "obs_"}[variable]
        found, time = results[variable], f"{prefix}time"
        if not self.labels:
            return _over_times(found, time)
        of_rows = found[f"{prefix}record"].values
        rows = [found.isel({found.dims[0]: of_rows == label}) for label in self.labels]
        return _side_by_side([_over_times(own, time) for own in rows], self.labels)

    def records_of(self, names: Sequence[str]) -> list[str]:
        """The record of each name that has one; nothing without a panel."""
        found = [[one for one in self.labels if n.startswith(named(one, ""))] for n in names]
        return [max(map(str, labels), key=len) for labels in found if labels]

    def connected(self, quantiles: xr.Dataset) -> xr.Dataset:
        """Quantiles without gaps at the times of other records."""
        return quantiles.interpolate_na("time") if self.labels else quantiles


def several_records(
    idata: xr.DataTree, group: str, name: str, variable: str, records: Any
) -> Facets:
    """Return records of a panel as facets of the group's array ``variable``."""
    _, results = group_of(idata, group)
    if (labels := _labels_for(results, name, "records", records)) is None:
        return Facets(idata, [], 1)
    chosen = _chosen(records, labels)
    trees = [one_record(idata, group, name, label) for label in chosen]
    of_group = [tree[group].to_dataset()[variable] for tree in trees]
    found = {group: _side_by_side(of_group, chosen).to_dataset(name=variable)}
    found[group].attrs = results.attrs
    if "observed_data" in trees[0].children:
        of_data = [tree["observed_data"].to_dataset()[name] for tree in trees]
        found["observed_data"] = _side_by_side(of_data, chosen).to_dataset(name=name)
    return Facets(xr.DataTree.from_dict(found), chosen, _in_line(chosen, of_group[0].shape[-1]))


def facets_of_simulation(simulated: xr.Dataset, records: Any) -> Facets:
    """Return the records of a result of `simulate` as facets, which have no draws."""
    if "record" not in simulated.coords:
        if records is not None:
            raise ModelError(f"records must be None without a panel, got {records!r}")
        return Facets(xr.DataTree(), [], 1)
    chosen = _chosen(records, list(dict.fromkeys(simulated["record"].values.tolist())))
    return Facets(xr.DataTree(), chosen, _in_line(chosen, simulated.sizes["state"]))


def _in_line(labels: Sequence[Any], n_names: int) -> int:
    """How many panels of a figure are beside each other: those of a record, or some records."""
    return n_names if n_names > 1 else min(RECORDS_IN_LINE, len(labels))


def _labels_for(results: xr.Dataset, name: str, argument: str, given: Any) -> list[Any] | None:
    """Return the labels of a panel; None without one, where nothing may be given."""
    if (labels := results.coords.get(f"{name}_panel")) is not None:
        return list(dict.fromkeys(labels.values.tolist()))
    if given is not None:
        raise ModelError(f"{argument} must be None, because {name!r} is no panel, got {given!r}")
    return None


def _chosen(records: Any, labels: list[Any]) -> list[Any]:
    if records is None:
        return labels[:MOST_RECORDS]
    is_list = isinstance(records, Iterable) and not isinstance(records, str)
    chosen = list(records) if is_list else [records]
    if not chosen or any(label not in labels for label in chosen):
        raise ModelError(f"records must be labels of the panel, among {labels}, got {records!r}")
    return chosen


def named(label: Any, name: str) -> str:
    """Return the name of a state or an observable of a record."""
    return f"{label}: {name}"


def _over_times(array: xr.DataArray, time: str) -> xr.DataArray:
    """Give the rows, the first dimension, their times as only coordinate."""
    times, dim = array[time], array.dims[0]
    kept = array.drop_vars([name for name, c in array.coords.items() if dim in c.dims])
    return kept.rename({dim: "time"}).assign_coords(time=("time", times.values, times.attrs))


def _rows_of(results: xr.Dataset, name: str, record: Any) -> xr.Dataset:
    """Select the rows and the results of one record."""
    (dim,) = results[f"{name}_panel"].dims
    found = results.isel({dim: results[f"{name}_panel"].values == record})
    of_records = f"{name}_record"
    if of_records in found.dims:
        found = found.sel({of_records: record}, drop=True)
    times = found[f"{name}_time"]
    found = found.drop_vars([dim, f"{name}_panel", f"{name}_time"], errors="ignore")
    found = found.rename({dim: f"{name}_time"})
    return found.assign_coords({f"{name}_time": (f"{name}_time", times.values, times.attrs)})


def _data_of(idata: xr.DataTree, name: str, labels: Sequence[Any]) -> xr.Dataset | None:
    """Return the observations with record and time of each row, if idata has these."""
    if "observed_data" not in idata.children or "constant_data" not in idata.children:
        return None
    data, known = idata["observed_data"].to_dataset(), idata["constant_data"].to_dataset()
    if not {f"{name}_panel", f"{name}_time"} <= set(known) or name not in data:
        return None
    return data[[name]].assign_coords(_coords_of_rows(known, name, labels, data[name].dims[0]))


def _coords_of_rows(
    known: xr.Dataset, name: str, labels: Sequence[Any] | None, row: Hashable
) -> dict[str, Any]:
    """Record and time of each row, along the dimension ``row``, from constant data."""
    of_rows = known[f"{name}_panel"].values
    if labels and isinstance(labels[0], str):  # their data are numbers of records
        of_rows = np.array(labels)[of_rows]
    times = known[f"{name}_time"]
    return {f"{name}_panel": (row, of_rows), f"{name}_time": (row, times.values, times.attrs)}


def _side_by_side(parts: Sequence[xr.DataArray], labels: Sequence[Any]) -> xr.DataArray:
    """Join arrays of records along their last dimension, with the names of each record."""
    dim = parts[0].dims[-1]
    names = [str(name) for name in parts[0][dim].values]
    renamed = [
        part.assign_coords({dim: [named(label, name) for name in names]})
        for label, part in zip(labels, parts, strict=True)
    ]
    joined = xr.concat(renamed, dim, join="outer", combine_attrs="override")
    units = {name: unit for name in names if (unit := unit_of(name, parts[0])) is not None}
    joined.attrs["units"] = {named(label, n): u for label in labels for n, u in units.items()}
    return joined
