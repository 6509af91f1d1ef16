"""Functions of states and observations that are drawn instead of them."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from ..errors import ModelError
from .axes import unit_of, with_unit
from .results import check_names

Functions = Mapping[str, Callable[[Any], Any]]


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


def of_record(transform: Any, functions: Functions) -> Functions:
    """Return the functions of observations beside states: those that a mapping names."""
    return {} if callable(transform) else functions


def transformed(array: xr.DataArray, along: str, functions: Functions) -> xr.DataArray:
    """Apply to each entry along the dimension `along` its function, if it has one."""
    names = [str(name) for name in array[along].values]
    if not set(names) & set(functions):
        return array
    values = np.moveaxis(array.values.astype(float), array.get_axis_num(along), 0)
    for i, name in enumerate(names):
        if name not in functions:
            continue
        result = np.asarray(functions[name](values[i]))
        if result.shape != values[i].shape:
            raise ModelError(
                "transform must return an array of the shape it is given, "
                f"{values[i].shape} of {name!r}, got shape {result.shape}"
            )
        values[i] = result
    return array.copy(data=np.moveaxis(values, 0, array.get_axis_num(along)))


def axis_label(name: str, functions: Functions, *arrays: xr.DataArray | None) -> str:
    """Return "exp(name)" if that is drawn, else the name with its unit in the `arrays`."""
    if name not in functions:
        return with_unit(name, unit_of(name, *arrays))
    of_function = getattr(functions[name], "__name__", "")
    return f"{of_function}({name})" if of_function.isidentifier() else name
