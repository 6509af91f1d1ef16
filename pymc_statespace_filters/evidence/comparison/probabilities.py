"""Model probabilities from log weights with errors (Eq. 3.3)."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_softmax

from ...errors import ModelError

N_NORMALS = 50_000

Array = NDArray[np.float64]


class Probabilities(NamedTuple):
    """Probabilities of m models and the ends of their central intervals, each of shape (m,)."""

    prob: Array
    low: Array
    high: Array


def probabilities(log_weight: Array, se: Array, ci_prob: float) -> Probabilities:
    """Normalise weights, with intervals under independent normal errors of their logarithms.

    The normal draws are fixed: equal evidences give equal intervals, and along a curve of weights
    the intervals are smooth. One unknown error makes all intervals unknown, because every
    probability depends on it.
    """
    prob = np.exp(log_softmax(log_weight))
    if not np.isfinite(log_weight + se).all():
        unknown = np.full_like(prob, np.nan)
        return Probabilities(prob, unknown, unknown)
    normals = np.random.default_rng(0).standard_normal((N_NORMALS, len(se)))
    probs = np.exp(log_softmax(log_weight + se * normals, axis=1))
    low, high = np.quantile(probs, [(1 - ci_prob) / 2, (1 + ci_prob) / 2], axis=0)
    return Probabilities(prob, np.minimum(low, prob), np.maximum(high, prob))


def prior_weights(prior: Mapping[str, float] | None, names: list[str]) -> Array:
    """Check and normalise prior weights of models; equal ones by default."""
    if prior is None:
        return np.full(len(names), 1 / len(names))
    if not isinstance(prior, Mapping) or set(prior) != set(names):
        raise ModelError(f"prior must give a weight to exactly the models {names}, got {prior!r}")
    try:
        weights = np.array([prior[name] for name in names], dtype=np.float64)
    except (TypeError, ValueError):
        weights = np.array(np.nan)
    # Divide by the largest first: the sum may overflow. Ratios may still underflow to zero.
    ratios = np.clip(weights, 0, None) / (weights.max() if weights.max() > 0 else 1)
    if not (np.isfinite(weights).all() and (ratios > 0).all()):
        raise ModelError(f"prior must be positive and finite for every model, got {prior!r}")
    return ratios / ratios.sum()


def check_ci_prob(ci_prob: float) -> None:
    """Raise a `ModelError` unless it is a probability."""
    if not (isinstance(ci_prob, int | float) and 0 < ci_prob < 1):
        raise ModelError(f"ci_prob must be a number between 0 and 1, got {ci_prob!r}")
