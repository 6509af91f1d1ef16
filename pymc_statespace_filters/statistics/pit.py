"""Probability integral transforms of observations, by draws of their predictions."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def pit_of(
    observed: Array, predicted: Array, rng: np.random.Generator, flags: Array | float = 0.0
) -> Array:
    """Randomised probability integral transform of observations (...) given draws (S, ...).

    The rank of the observation among itself and the draws, randomised over ties and within the
    rank: uniform if the observation follows the distribution of the draws, for counts too (Czado,
    Gneiting and Held 2009). NaN where the observation is missing; NaN draws are ignored. Where
    ``flags`` (...) are -1 or 1, the observation lies somewhere below or above the number given.
    """
    n_draws = np.isfinite(predicted).sum(axis=0)
    below = (predicted < observed).sum(axis=0)
    ties = (predicted == observed).sum(axis=0)
    low = np.where(flags < 0.0, 0, below)
    high = np.where(flags > 0.0, n_draws + 1, below + ties + 1)
    pit = (low + rng.uniform(size=observed.shape) * (high - low)) / (n_draws + 1)
    return np.where(np.isnan(observed) | (n_draws == 0), np.nan, pit)
