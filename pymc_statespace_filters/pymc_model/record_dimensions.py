"""Variables of a model with a dimension of records, in the order of a panel's rows."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pymc as pm
from pytensor.graph.basic import Variable

from ..errors import ModelError
from ..system.labels import positions_of
from ..system.model import StateSpaceModel
from ..system.record import Record


def in_order_of_records(
    system: StateSpaceModel, values: Mapping[str, Any], model: pm.Model, panel: Record
) -> dict[str, Any]:
    """Values of parameters; those of each record are aligned by the coordinates of the records.

    Coordinates that count from zero are none, unless the labels of the records do as well. Raises
    `ModelError` if the coordinates are not the labels of the records, or in another order where the
    records may be replaced.
    """
    n_axes = {
        name: len(shape)
        for name, shape in zip(system.parameters, system.parameter_shapes, strict=True)
    }
    return {
        name: _aligned(name, value, model, panel) if np.ndim(value) > n_axes[name] else value
        for name, value in values.items()
    }


def _aligned(parameter: str, value: Any, model: pm.Model, panel: Record) -> Any:
    found, labels = _first_coordinates(value, model), panel.records.labels
    if found is None or found == labels:
        return value
    if found == list(range(len(found))) and set(found) != set(labels):
        return value
    order = positions_of(f"parameter {parameter!r}", found, labels)
    if order == list(range(len(order))):
        return value
    if isinstance(panel.n_records, Variable):
        raise ModelError(
            f"parameter {parameter!r} must have its records in the order of the rows of panel, "
            f"{labels}, where these may be replaced, got the coordinates {found}"
        )
    return value[np.array(order)]


def _first_coordinates(value: Any, model: pm.Model) -> list[Any] | None:
    """The coordinates of the first dimension of a variable of the model."""
    name = getattr(value, "name", None)
    if not isinstance(value, Variable) or model.named_vars.get(name) is not value:
        return None
    dims = model.named_vars_to_dims.get(name)
    coords = model.coords.get(dims[0]) if dims else None
    return None if coords is None else list(coords)
