"""Dimension names and DataTree groups of states."""

from collections.abc import Mapping, Sequence
from typing import Any

import xarray as xr

from pymc_statespace_filters.pymc_model.state_graphs import StateSpaceVariable


def state_dims(variables: Sequence[StateSpaceVariable]) -> dict[str, str]:
    """Name of the state dimension of each variable; the same one for the same states."""
    # Observables take precedence: their dimension may be called "state" in the model.
    lists = [v.system.observables for v in variables if "state" in v.dims]
    lists += [v.system.states for v in variables]
    return {
        v.name: "state" if v.system.states == lists[0] else f"{v.name}_state" for v in variables
    }


def add_group(
    idata: xr.DataTree, name: str, group: xr.Dataset, attrs: Mapping[str, Any], extend: bool
) -> xr.DataTree:
    """Add a group to `idata`, replacing one of that name, or return it in a new DataTree."""
    group = group.assign_attrs(attrs)
    if not extend:
        return xr.DataTree.from_dict({name: group})
    idata[name] = xr.DataTree(group)
    return idata
