"""From the unconstrained vector of a model back to its free variables."""

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pymc.pytensorf import compile as compile_pymc

Array = NDArray[np.float64]


class ConstrainedValues:
    """The free variables of a model as a function of its unconstrained vector.

    Attributes
    ----------
    names : list of str
        Of the free variables, in the order of the vector.
    """

    def __init__(self, model: pm.Model) -> None:
        values = [model.rvs_to_values[rv] for rv in model.free_RVs]
        outputs = model.replace_rvs_by_values(model.free_RVs)
        # Machine code would take seconds to compile.
        self._function = compile_pymc(values, outputs, mode="FAST_COMPILE")
        start = model.initial_point()
        self._shapes = [np.shape(start[value.name]) for value in values]
        self._ends = np.cumsum([int(np.prod(shape)) for shape in self._shapes])[:-1]
        self.names = [rv.name for rv in model.free_RVs]

    def __call__(self, x: Array) -> dict[str, np.ndarray]:
        """Values by name at the unconstrained point x (k,)."""
        parts = zip(np.split(x, self._ends), self._shapes, strict=True)
        found = self._function(*(part.reshape(shape) for part, shape in parts))
        return dict(zip(self.names, map(np.asarray, found), strict=True))
