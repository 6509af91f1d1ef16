"""Populations put together, each weighted by its evidence, and the errors that their spread gives.

The mean over populations is one over their weighted particles, in which a population counts by its
estimate of the evidence: one that has missed a mode has a smaller one.
"""

import math

import numpy as np
from numpy.typing import NDArray

from ..statistics.importance import log_sum, normalised, student_factor, systematic
from .particles import Populations

Array = NDArray[np.float64]


def merged_log_evidence(log_evidences: Array) -> tuple[Array, Array]:
    """Log of the mean of the evidences (R, ...), and its standard error from their spread."""
    count = len(log_evidences)
    merged = log_sum(log_evidences, axis=0) - math.log(count)
    with np.errstate(invalid="ignore"):
        relative = np.exp(log_evidences - merged).std(axis=0, ddof=1)
    return np.asarray(merged), relative / math.sqrt(count) * student_factor(count)


def merged_scores(log_evidences: Array) -> tuple[Array, Array]:
    """Scores log p(d_j | d_1 .. d_{j-1}) from evidences (R, J) of the data up to j; deviations.

    The deviations (R, J) of the populations are scaled so that the sum over populations of the
    product of two columns is the covariance of the errors of two scores. Errors of evidences of
    successive rows are nearly the same, and cancel in their ratio.
    """
    count = len(log_evidences)
    before = np.concatenate([np.zeros((count, 1)), log_evidences[:, :-1]], axis=1)
    merged, merged_before = (merged_log_evidence(values)[0] for values in (log_evidences, before))
    influence = np.exp(log_evidences - merged) - np.exp(before - merged_before)
    scale = student_factor(count) / math.sqrt(count * (count - 1))
    return merged - merged_before, influence * scale


def merged_index(
    populations: Populations, log_evidences: Array, count: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """So many particles of all populations, in their order, each equally likely a draw."""
    weights = normalised(log_evidences)[:, np.newaxis] * np.exp(populations.log_weights)
    return systematic(weights.ravel(), count, rng)


def mean_and_error(values: Array, populations: Populations, log_evidences: Array) -> Array:
    """Merged mean of values (R * N, ...) and its Monte Carlo standard error, (2, ...)."""
    n_populations, size = populations.log_weights.shape
    within = np.exp(populations.log_weights)
    by_population = np.einsum(
        "rn,rn...->r...", within, values.reshape(n_populations, size, *values.shape[1:])
    )
    shares = normalised(log_evidences)
    mean = np.tensordot(shares, by_population, axes=1)
    squared = np.tensordot(shares**2, (by_population - mean) ** 2, axes=1)
    inflated = math.sqrt(n_populations / (n_populations - 1)) * student_factor(n_populations)
    return np.stack([mean, np.sqrt(squared) * inflated])
