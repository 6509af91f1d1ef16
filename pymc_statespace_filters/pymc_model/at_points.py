"""Graphs of a model's variables as functions of points of its unconstrained space, by NumPy.

All points are evaluated in one call. Machine code would take seconds to compile.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pymc as pm
import pytensor
from numpy.typing import NDArray
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from ..compiler.native.rows import at_points

Array = NDArray[np.float64]


class GraphsAtPoints:
    """Graphs of a model's variables at points.

    Those of its value variables if a ``point`` has a value of each, in the order of the vector.
    """

    def __init__(
        self,
        model: pm.Model,
        graphs: Sequence[Variable],
        point: Mapping[TensorVariable, Array] | None = None,
    ) -> None:
        if point is None:
            start, graphs = model.initial_point(), model.replace_rvs_by_values(list(graphs))
            values = [model.rvs_to_values[rv] for rv in model.free_RVs]
            point = {value: start[value.name] for value in values}
        self._shapes = [np.shape(value) for value in point.values()]
        self._ends = np.cumsum([np.size(value) for value in point.values()])[:-1]
        symbols, outputs = at_points(list(point), graphs)
        self._types = [symbol.dtype for symbol in symbols]
        self._function = pytensor.function(
            symbols, outputs, mode="FAST_COMPILE", on_unused_input="ignore", trust_input=True
        )

    def __call__(self, x: Array) -> list[np.ndarray]:
        """Each of the graphs (..., *shape) at points x (..., k)."""
        rows = x.reshape(-1, x.shape[-1])
        parts = zip(np.split(rows, self._ends, axis=1), self._shapes, self._types, strict=True)
        found = self._function(
            *(part.reshape(len(rows), *shape).astype(kind) for part, shape, kind in parts)
        )
        return [np.reshape(value, (*x.shape[:-1], *value.shape[1:])) for value in found]


class ConstrainedValues:
    """Variables of a model as a function of its unconstrained vector.

    ``variables`` are by default the free ones, in the order of the vector; ``names`` are theirs.
    """

    def __init__(self, model: pm.Model, variables: Sequence[TensorVariable] | None = None) -> None:
        chosen = model.free_RVs if variables is None else variables
        self._at_points, self.names = GraphsAtPoints(model, chosen), [v.name for v in chosen]

    def __call__(self, x: Array) -> dict[str, np.ndarray]:
        """Values by name (..., *shape) at points x (..., k)."""
        return dict(zip(self.names, self._at_points(x), strict=True))
