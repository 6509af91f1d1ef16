"""The two factors of a model's posterior: prior and likelihood, at many points."""

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from .density import ModelDensity
from .prior import ModelPrior

Array = NDArray[np.float64]


class ModelFactors:
    """Log prior and log-likelihood of a model on its unconstrained space.

    The likelihood is everything in the model except the priors of the free variables, Potentials
    included: the log-density minus the log prior. The Jacobians of the transforms belong to the
    prior.

    Attributes
    ----------
    density : ModelDensity
    prior : ModelPrior
    """

    def __init__(self, model: pm.Model) -> None:
        self.density, self.prior = ModelDensity(model), ModelPrior(model)

    @property
    def is_noisy(self) -> bool:
        """Whether the likelihood is a random estimate."""
        return bool(self.density.seed_names)

    def evaluate(self, x: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Log prior and log-likelihood of points x (m, k), each (m,); -inf instead of NaN.

        A noisy likelihood is estimated with fresh noise at every point.
        """
        seeds = rng.integers(np.iinfo(np.int64).max, size=(len(x), len(self.density.seed_names)))
        log_prior = self.prior.log_density(x)
        with np.errstate(invalid="ignore"):
            log_likelihood = self.density.evaluate(x, seeds) - log_prior
        return log_prior, np.where(np.isfinite(log_likelihood), log_likelihood, -np.inf)
