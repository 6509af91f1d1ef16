"""Columns of pandas and xarray data, put in the order in which a system names its components."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from ..errors import ModelError
from .checks import check_floats, shortened


def default_names(letter: str, n: int) -> list[str]:
    """Names of components that a user did not name: x0, x1 and so on."""
    return [f"{letter}{i}" for i in range(n)]


def element_label(name: str, index: Sequence[Any]) -> str:
    """The name of an element of an array, such as "b[2]"; of a scalar, that of the scalar."""
    return f"{name}[{', '.join(map(str, index))}]" if index else name


def columns_in_order(name: str, value: Any, components: Sequence[str], role: str) -> Any:
    """The data ``value`` with one column for each component, aligned by label.

    Data without labels are returned as they are, and so are those of a system whose components
    have no names of their own. ``role`` is what the components are called, such as "observables".
    """
    if isinstance(value, xr.DataArray):
        value = _with_columns_last(value, components, role.removesuffix("s"))
    labels = _labels_of(value)
    if labels is None or _are_default(labels) or _are_default(components):
        return value
    positions = [labels.index(component) for component in components if component in labels]
    if not len(positions) == len(components) == len(labels):
        raise ModelError(
            f"{name} must have a column for each of the {role} {list(components)}, got the columns "
            f"{shortened(labels)}: rename and select them, or give an array, whose columns are "
            "taken by position"
        )
    return np.asarray(value)[:, positions]


def table_of(
    name: str, value: Any, components: Sequence[str], role: str, *, missing: bool = False
) -> np.ndarray:
    """Numbers with a column for each component, see `columns_in_order`; of one, also a vector."""
    array = check_floats(
        name, columns_in_order(name, value, components, role), None, missing=missing
    )
    return array[:, None] if array.ndim == 1 and len(components) == 1 else array


def rows_in_order(name: str, value: Any, labels: Sequence[Any]) -> Any:
    """Values of which one is for each record, aligned by the labels of records where they have any.

    That is an index of a Series, unless it counts from zero, or the first coordinate of a
    DataArray.
    """
    if isinstance(value, pd.Series) and not isinstance(value.index, pd.RangeIndex):
        found = value.index.tolist()
    elif isinstance(value, xr.DataArray) and value.ndim and value.dims[0] in value.coords:
        found = value[value.dims[0]].values.tolist()
    else:
        return value
    return np.asarray(value)[positions_of(name, found, labels)]


def positions_of(name: str, found: Sequence[Any], labels: Sequence[Any]) -> list[int]:
    """Where in values for the labels ``found`` that of each record is."""
    positions = {str(label): i for i, label in enumerate(found)}
    if sorted(map(str, found)) != sorted(map(str, labels)):
        raise ModelError(
            f"{name} must have a value for each record, {shortened(list(labels))}, got values for "
            f"{shortened(list(found))}"
        )
    return [positions[str(label)] for label in labels]


def _with_columns_last(value: xr.DataArray, components: Sequence[str], dim: str) -> xr.DataArray:
    """A table (rows, columns): the columns are the dimension of the components' name or labels."""
    if value.ndim != 2:
        return value
    named = [d for d in value.dims if d == dim]
    labelled = [d for d in value.dims if set(components) <= set(value[d].values.tolist())]
    columns = (named or labelled or [value.dims[-1]])[0]
    return value.transpose(..., columns)


def _labels_of(value: Any) -> list[Any] | None:
    """Labels of the columns of a table; None if it has none."""
    if isinstance(value, pd.DataFrame):
        return value.columns.tolist()
    if isinstance(value, xr.DataArray) and value.ndim == 2 and value.dims[-1] in value.coords:
        return value[value.dims[-1]].values.tolist()
    return None


def _are_default(labels: Sequence[Any]) -> bool:
    """Whether labels are numbers of columns, or the names of components without a name."""
    n = len(labels)
    return list(labels) in (list(range(n)), default_names("y", n))
