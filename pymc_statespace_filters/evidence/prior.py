"""The prior of a model on its unconstrained space: its log-density, and draws from it."""

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pymc.pytensorf import compile as compile_pymc
from pymc.pytensorf import join_nonshared_inputs

Array = NDArray[np.float64]


class ModelPrior:
    """The law of the free variables of a model; Potentials belong to the likelihood.

    Parameters
    ----------
    model : pymc.Model
    """

    def __init__(self, model: pm.Model) -> None:
        self._model = model
        values = [model.rvs_to_values[rv] for rv in model.free_RVs]
        outputs = [model.logp(vars=model.free_RVs)]
        (output,), joined = join_nonshared_inputs(model.initial_point(), outputs, values)
        self._log_density = compile_pymc([joined], output)
        self._log_density.trust_input = True

    def log_density(self, x: Array) -> Array:
        """Log-density of points x (m, k) with the Jacobians of the transforms; NaN becomes -inf."""
        found = np.array([self._log_density(point) for point in x], dtype=np.float64)
        return np.where(np.isnan(found), -np.inf, found)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Independent draws, shape (count, k)."""
        raise NotImplementedError
