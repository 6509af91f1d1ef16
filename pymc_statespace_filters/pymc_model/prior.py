"""The prior of a model on its unconstrained space: log-density, random draws, and likelihood."""

from functools import cached_property
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from numpy.typing import NDArray
from pymc.pytensorf import collect_default_updates, reseed_rngs
from pymc.pytensorf import compile as compile_pymc
from pytensor.compile import SharedVariable

from ..errors import ModelError
from .density import ModelDensity, RowFunction
from .support import can_sample, is_restricted

Array = NDArray[np.float64]


class ModelPrior:
    """The distribution of a model's free variables; Potentials belong to the likelihood."""

    def __init__(self, model: pm.Model) -> None:
        self._model = model

    def log_density(self, x: Array) -> Array:
        """Log-density of points x (m, k), Jacobians included; NaN becomes -inf."""
        return self._density.evaluate(x)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Independent draws, shape (count, k), in the order of `log_density`.

        Raises
        ------
        ModelError
            If a prior cannot be sampled, like ``pm.Flat``; if a transform excludes a part of the
            support, as an ordering does, so that the density is not that of the draws; or if draws
            are rounded to the edge of the support, where the transform is infinite.
        """
        model = self._model
        if improper := [rv.name for rv in model.free_RVs if not can_sample(rv, model)]:
            raise ModelError(
                f"the prior of {', '.join(improper)} is improper and cannot be sampled: "
                "give it a proper prior"
            )
        if restricted := [rv.name for rv in model.free_RVs if is_restricted(rv, model)]:
            raise ModelError(
                f"the prior of {', '.join(restricted)} cannot be sampled: its transform excludes "
                "a part of the distribution's support, and the density is not normalised"
            )
        draw, generators = self._draw
        reseed_rngs(generators, int(rng.integers(2**31)))
        try:
            draws = [np.concatenate(draw()) for _ in range(count)]
        except NotImplementedError as error:
            raise ModelError(f"the prior cannot be sampled: {error}") from None
        found = np.array(draws, dtype=np.float64).reshape(count, -1)
        if on_edge := int((~np.isfinite(found)).any(axis=-1).sum()):
            raise ModelError(
                f"{on_edge} of {count} draws of the prior are rounded to the edge of their "
                "support, where the transform is infinite: give the model a prior with less mass "
                "there"
            )
        return found

    @cached_property
    def _density(self) -> RowFunction:
        return RowFunction(self._model, self._model.logp(vars=self._model.free_RVs))

    @cached_property
    def _draw(self) -> tuple[Any, list[SharedVariable]]:
        """A function that draws all free variables, unconstrained, and its generators."""
        mapped = []
        for rv in self._model.free_RVs:
            transform = self._model.rvs_to_transforms[rv]
            value = rv if transform is None else transform.forward(rv, *rv.owner.inputs)
            mapped.append(pt.flatten(value))
        # Machine code would take seconds to compile and halve the time of a draw, about 0.1 ms.
        draw = compile_pymc([], mapped, mode="FAST_COMPILE")
        return draw, list(collect_default_updates(inputs=[], outputs=mapped))


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
