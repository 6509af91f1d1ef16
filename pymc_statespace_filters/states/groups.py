"""Dimensions, coordinates and DataTree groups of states."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..pymc_model.state_space_variable import StateSpaceVariable, observed_variables
from .record import Array
from .variable import VariableAtDraws


def state_dims(variables: Sequence[StateSpaceVariable]) -> dict[str, str]:
    """Name of the state dimension of each variable; the same one for the same states."""
    # Observables take precedence: their dimension may be called "state" in the model.
    lists = [v.system.observables for v in variables if "state" in v.dims]
    lists += [v.system.states for v in variables]
    return {
        v.name: "state" if v.system.states == lists[0] else f"{v.name}_state" for v in variables
    }


def results_by_row(
    at_draws: VariableAtDraws,
    times: Sequence[Array],
    found: Mapping[str, tuple[str, Sequence[Array]]],
) -> xr.Dataset:
    """Results by draw and row, (chain, draw, R, ...), with the coordinates of rows and of names.

    ``times`` are those of the rows of each record. Of each of the ``found`` there is the dimension
    after the rows, "state" or "observable" or "" for none, and the array (draws, rows, ...) of each
    record.
    """
    variable = at_draws.variable
    time, observable = variable.dims
    dims = state_dims(observed_variables(at_draws.model))
    names = {
        "state": (dims[variable.name], list(variable.system.states)),
        "observable": (observable, list(variable.system.observables)),
    }
    used = [names[kind] for kind, _ in found.values() if kind]
    return at_draws.draws.dataset(
        {
            name: ((time, names[kind][0]) if kind else (time,), np.concatenate(parts, axis=1))
            for name, (kind, parts) in found.items()
        },
        _row_coords(at_draws, times) | dict(used),
    )


def times_of(at_draws: VariableAtDraws, steps: Sequence[NDArray[np.int64]]) -> list[Array]:
    """The times of some steps of each record in the data."""
    pairs = zip(at_draws.records, steps, strict=True)
    return [record.axis.times(rows) for record, rows in pairs]


def _row_coords(at_draws: VariableAtDraws, times: Sequence[Array]) -> dict[str, Any]:
    """Coordinates of the rows of a result, given the times of each record.

    Without a panel they are times. The rows of a panel have record and time as further coordinates.
    """
    name, dim = at_draws.variable.name, at_draws.variable.dims[0]
    pairs = list(zip(at_draws.records, times, strict=True))
    shown = np.concatenate([record.shown(own) for record, own in pairs])
    if not at_draws.variable.is_panel:
        return {dim: shown}
    labels = np.repeat(
        np.array([record.label for record in at_draws.records]), [len(own) for own in times]
    )
    return {
        dim: np.arange(shown.size),
        f"{name}_panel": (dim, labels),
        f"{name}_time": (dim, shown),
    }


def by_record(at_draws: VariableAtDraws, parts: Sequence[xr.Dataset]) -> xr.Dataset:
    """Join results that each record has one of, along a dimension of records if it is a panel.

    Where their coordinates differ, as lags of records of different lengths, NaN fills the gaps.
    """
    if not at_draws.variable.is_panel:
        return parts[0]
    dim = f"{at_draws.variable.name}_record"
    labels = xr.DataArray([record.label for record in at_draws.records], dims=dim, name=dim)
    return xr.concat(parts, labels, data_vars="all", coords="minimal", join="outer")


def add_group(
    idata: xr.DataTree, name: str, group: xr.Dataset, attrs: Mapping[str, Any], extend: bool
) -> xr.DataTree:
    """Add a group to `idata`, replacing one of that name, or return it in a new DataTree."""
    group = group.assign_attrs(attrs)
    if not extend:
        return xr.DataTree.from_dict({name: group})
    idata[name] = xr.DataTree(group)
    return idata
