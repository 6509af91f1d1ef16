"""The points at which filters are compared: draws of the posterior, and points around them.

Where a filter's likelihood is far too low its chain stays away, so that draws alone cannot show it.
"""

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from ...errors import ModelError
from ...pymc_model.prior import ModelPrior

Array = NDArray[np.float64]

SPREADS = (2.0, 3.0)  # of the points around the posterior, in its own spread
_PRIOR_SHARE = 0.2  # of the points elsewhere


def points_elsewhere(
    model: pm.Model, draws: Array, n: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Points (n, k) of the unconstrained space around draws or in the prior, in mixed order.

    With each the factor by which it was moved away from the mean of the draws, of the prior
    infinity.
    """
    prior = _prior_draws(model, round(_PRIOR_SHARE * n), rng)
    prior = prior if len(prior) else draws[:0]
    factors, mean = np.resize(SPREADS, n - len(prior)), draws.mean(axis=0)
    moved = mean + factors[:, None] * (draws[rng.integers(len(draws), size=len(factors))] - mean)
    order = rng.permutation(n)
    factors = np.concatenate([factors, np.full(len(prior), np.inf)])
    return np.concatenate([moved, prior])[order], factors[order]


def _prior_draws(model: pm.Model, n: int, rng: np.random.Generator) -> Array:
    """Draws of the prior (n, k); an empty array if it cannot be sampled."""
    try:
        return ModelPrior(model).sample(n, rng) if n else np.empty(0)
    except ModelError:
        return np.empty(0)
