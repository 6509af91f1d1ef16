"""The scalars of a model's free variables, by the names that users give them.

An element of a vector is named by its position, ``"k[2]"``, or by the coordinates of its
dimensions, ``"k[z^3]"``, as ArviZ labels it. The vector itself names all of them.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
from numpy.typing import NDArray
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from ..system.labels import element_label

Columns = tuple[int, ...]


@dataclass(frozen=True)
class Elements:
    """What the k columns of a model's unconstrained vector are called.

    Each has a label by coordinates where its dimensions have them, by position elsewhere.
    ``meanings`` has names of variables and elements, each with all sets of columns that it may
    stand for.
    """

    labels: tuple[str, ...]
    variables: tuple[str, ...]  # of every column
    meanings: Mapping[str, frozenset[Columns]]

    @classmethod
    def of(cls, model: pm.Model) -> "Elements":
        """Those of a model."""
        labels: list[str] = []
        variables: list[str] = []
        meanings: dict[str, set[Columns]] = defaultdict(set)
        for variable, at in places_in_vector(model).items():
            own, positions = labels_of(variable, at.shape, model), _positions(variable, at.shape)
            columns = at.ravel().tolist()
            meanings[variable].add(tuple(columns))
            for column, *names in zip(columns, own, positions, strict=True):
                for name in names:
                    meanings[name].add((column,))
            labels += own
            variables += [variable] * len(own)
        frozen = {name: frozenset(found) for name, found in meanings.items()}
        return cls(tuple(labels), tuple(variables), frozen)

    def columns(self, name: Any, argument: str) -> Columns:
        """The columns that a name in an argument stands for.

        Raises `ModelError` if it is unknown, or stands for two elements.
        """
        found = self.meanings.get(name, frozenset())
        if len(found) == 1:
            return next(iter(found))
        if found:
            raise ModelError(
                f"{argument} must name one element, got {name!r}, which is one by its position and "
                "another by its coordinate: give the model coordinates that are no numbers"
            )
        own = str(name).partition("[")[0]
        known = [label for label, of in zip(self.labels, self.variables, strict=True) if of == own]
        what = f"{own!r} has {known}" if known else f"the model has {list(self.labels)}"
        raise ModelError(
            f"{argument} must name free variables of the model, or elements of them, got {name!r}: "
            f"{what}"
        )


def places_in_vector(model: pm.Model) -> dict[str, NDArray[np.int64]]:
    """For every free variable the columns of its scalars, in the shape of its value."""
    start, first, places = model.initial_point(), 0, {}
    for rv in model.free_RVs:
        shape = np.shape(start[model.rvs_to_values[rv].name])
        size = math.prod(shape)
        places[rv.name] = np.arange(first, first + size).reshape(shape)
        first += size
    return places


def element_names(model: pm.Model, values: Sequence[TensorVariable] | None = None) -> list[str]:
    """Name each element of the flat vector of some values, such as "k[z^3]" or "theta[1]".

    Default: those of the free variables, in their order.
    """
    point = model.initial_point()
    return [
        label
        for value in values or [model.rvs_to_values[rv] for rv in model.free_RVs]
        for label in labels_of(model.values_to_rvs[value].name, point[value.name].shape, model)
    ]


def labels_of(name: str, shape: tuple[int, ...], model: pm.Model) -> list[str]:
    """The labels of a variable of this shape: ArviZ's, by position where these are not unique."""
    dims = model.named_vars_to_dims.get(name) or (None,) * len(shape)
    coords = [model.coords.get(dim) for dim in dims]
    axes = [
        range(n) if values is None or len(values) != n else np.asarray(pd.Index(values))
        for values, n in zip(coords, shape, strict=True)
    ]
    labels = [element_label(name, one) for one in product(*axes)]
    return labels if len(set(labels)) == len(labels) else _positions(name, shape)


def _positions(name: str, shape: tuple[int, ...]) -> list[str]:
    return [element_label(name, one) for one in np.ndindex(shape)]
