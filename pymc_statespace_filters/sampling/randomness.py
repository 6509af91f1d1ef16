"""Random numbers of a chain, drawn for many iterations at a time.

One call of a generator costs microseconds whether it returns one number or a thousand. A batch is
plain data, so a chain's state can be stored and taken up again in the middle of one.
"""

from typing import NamedTuple

import numpy as np

ITERATIONS = 64


class Batch(NamedTuple):
    """Random numbers of ``ITERATIONS`` iterations.

    Attributes
    ----------
    normals : ndarray, shape (iterations, stages, d)
        Standard normals, for the proposals.
    log_uniforms : ndarray, shape (iterations, stages)
        Logs of uniforms, for acceptance.
    seeds : ndarray of int64, shape (iterations, stages, noisy)
        Seeds of the likelihoods' own noise.
    used : int
        Iterations already spent.
    """

    normals: np.ndarray
    log_uniforms: np.ndarray
    seeds: np.ndarray
    used: int


class Share(NamedTuple):
    """Random numbers of one iteration, one row a stage.

    Attributes
    ----------
    normals : ndarray, shape (stages, d)
    log_uniforms : ndarray, shape (stages,)
    seeds : ndarray of int64, shape (stages, noisy)
    """

    normals: np.ndarray
    log_uniforms: np.ndarray
    seeds: np.ndarray


def take(
    batch: Batch | None, rng: np.random.Generator, n_stages: int, dim: int, n_noisy: int
) -> tuple[Batch, Share]:
    """Take one iteration's share of a batch, drawing the next batch where one is spent.

    Parameters
    ----------
    batch : Batch or None
        None before the first iteration.
    rng : numpy.random.Generator
    n_stages, dim, n_noisy : int
        Most stages of an iteration, dimension d, noisy variables.

    Returns
    -------
    Batch
        The same with one iteration more spent.
    Share
    """
    if batch is None or batch.used == ITERATIONS:
        batch = Batch(
            rng.standard_normal((ITERATIONS, n_stages, dim)),
            -rng.standard_exponential((ITERATIONS, n_stages)),
            draw_seeds(rng, (ITERATIONS, n_stages, n_noisy)),
            0,
        )
    now = batch.used
    share = Share(batch.normals[now], batch.log_uniforms[now], batch.seeds[now])
    return batch._replace(used=now + 1), share


def draw_seeds(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Draw seeds of noise, non-negative int64 of the given shape."""
    return rng.integers(0, np.iinfo(np.int64).max, size=shape, dtype=np.int64)
