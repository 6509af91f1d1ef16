"""From the unconstrained vector of a model back to its free variables."""

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from .compilation import compile_raveled

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
        mode = "FAST_COMPILE"
        self._function, _ = compile_raveled(model.initial_point(), outputs, values, mode=mode)
        self.names = [rv.name for rv in model.free_RVs]

    def __call__(self, x: Array) -> dict[str, np.ndarray]:
        """Values by name at the unconstrained point x (k,)."""
        return dict(zip(self.names, map(np.asarray, self._function(x)), strict=True))
