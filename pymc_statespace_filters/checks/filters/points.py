"""The points at which filters are compared: draws of the posterior, and points around them.

Where a filter's likelihood is far too low its chain stays away, so that draws alone cannot show it.
"""

from typing import NamedTuple

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from ...errors import ModelError
from ...pymc_model.prior import ModelPrior

Array = NDArray[np.float64]

_SPREADS = (2.0, 3.0)  # of the points around the posterior, in its own spread
_PRIOR_SHARE = 0.2  # of the points elsewhere


class Points(NamedTuple):
    """Points of the unconstrained space, draws and others in turn.

    Attributes
    ----------
    x : ndarray, shape (m, k)
    z : ndarray, shape (m, k)
        The same, from the mean of all draws in their standard deviations.
    spread : ndarray, shape (m,)
        1 for a draw, 2 or 3 for one that was moved away from the mean by this factor, 0 for a draw
        of the prior.
    """

    x: Array
    z: Array
    spread: Array


def choose_points(model: pm.Model, draws: Array, n_points: int, rng: np.random.Generator) -> Points:
    """Half of the points are draws (n, k), the others lie around them or in the prior."""
    n_draws = (n_points + 1) // 2
    own = draws[np.linspace(0, len(draws) - 1, n_draws).round().astype(int)]
    prior = _prior_draws(model, round(_PRIOR_SHARE * (n_points - n_draws)), rng)
    prior = prior if len(prior) else own[:0]
    factors = np.resize(_SPREADS, n_points - n_draws - len(prior))
    mean, sd = draws.mean(axis=0), draws.std(axis=0)
    moved = mean + factors[:, None] * (draws[rng.integers(len(draws), size=len(factors))] - mean)
    x = np.concatenate([own, moved, prior])
    spread = np.concatenate([np.ones(n_draws), factors, np.zeros(len(prior))])
    places = np.concatenate([np.arange(n_draws), 0.5 + rng.permutation(n_points - n_draws)])
    order = np.argsort(places)
    return Points(x[order], (x[order] - mean) / np.where(sd > 0.0, sd, 1.0), spread[order])


def _prior_draws(model: pm.Model, n: int, rng: np.random.Generator) -> Array:
    """Draws of the prior (n, k); an empty array if it cannot be sampled."""
    try:
        return ModelPrior(model).sample(n, rng) if n else np.empty(0)
    except ModelError:
        return np.empty(0)
