r"""Probabilities of sub-models and of terms, and how uncertain evidences make them.

With :math:`p_M \propto \pi_M Z_M` and independent relative errors :math:`c_M` of the evidences,

.. math::

    P_j = \sum_{M \ni j} p_M, \qquad
    \mathrm{var}\,P_j = \sum_M p_M^2\, (1[j \in M] - P_j)^2\, c_M^2 ,

to first order, and likewise for the presence of pairs and for a sub-model itself.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..statistics.importance import normalised
from .submodel_density import Array, Sets


@dataclass(frozen=True)
class Probabilities:
    """What evidences of sub-models say about terms."""

    present: Sets  # (S, K), the terms of the sub-models
    log_prior: Array  # (S,)
    log_evidence: Array  # (S,)
    error: Array  # (S,), relative, of the evidences
    missed: Array | float = 0.0  # (K,), how far other sub-models may move the inclusions

    @cached_property
    def of_models(self) -> Array:
        """Probabilities of the sub-models, (S,)."""
        return normalised(self.log_prior + self.log_evidence)

    @cached_property
    def _uncertain(self) -> Array:
        """The standard errors of the unnormalised probabilities, (S,)."""
        known = np.where(np.isfinite(self.error), self.error, 0.0)
        return np.asarray(self.of_models * known)

    @cached_property
    def inclusion(self) -> Array:
        """Probabilities of inclusion, (K,)."""
        return np.asarray(self.of_models @ self.present)

    @cached_property
    def inclusion_se(self) -> Array:
        """Their standard errors, (K,)."""
        variance = self._uncertain**2 @ (self.present - self.inclusion) ** 2
        return np.asarray(np.sqrt(variance + self.missed**2))

    @property
    def pairs(self) -> Array:
        """Probabilities that two terms are present together, (K, K)."""
        return np.asarray(self.present.T @ (self.of_models[:, None] * self.present))

    @property
    def of_models_se(self) -> Array:
        """Standard errors of the probabilities of the sub-models, (S,)."""
        all_others = (self._uncertain**2).sum() * self.of_models**2
        own = self._uncertain**2 * (1 - 2 * self.of_models)
        return np.asarray(np.sqrt(np.maximum(all_others + own, 0.0)))

    def influence(self) -> Array:
        """How much the log-evidence of each sub-model moves any inclusion, at most (S,)."""
        distance = np.abs(self.present - self.inclusion).max(axis=1)
        return np.asarray(self.of_models * distance)
