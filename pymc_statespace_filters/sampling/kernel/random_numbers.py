"""Random numbers of a chain, drawn for a block of iterations at a time.

One call of a generator costs microseconds whether it returns one number or a thousand. A block of
numbers is a function of the chain's key and the block's index, so that a chain can be resumed at
any iteration, on any rank.
"""

import numpy as np

from ...student_mixture import DEGREES_OF_FREEDOM
from .state import RandomBlock

BLOCK = 256


def random_block(key: np.ndarray, index: int, n_stages: int, dim: int, n_noisy: int) -> RandomBlock:
    """Draw a chain's random numbers for iterations ``index * BLOCK`` to ``(index + 1) * BLOCK``."""
    rng = generator_of_block(key, index)
    return RandomBlock(
        rng.standard_normal((BLOCK, n_stages, dim)),
        -rng.standard_exponential((BLOCK, n_stages + 1)),
        draw_seeds(rng, (BLOCK, n_stages, n_noisy)),
        rng.random((BLOCK, 2)),
        np.sqrt(DEGREES_OF_FREEDOM / rng.chisquare(DEGREES_OF_FREEDOM, BLOCK)),
    )


def generator_of_block(key: np.ndarray, index: int) -> np.random.Generator:
    """Make the generator of a block; consecutive ones start 2^128 numbers apart."""
    return np.random.Generator(np.random.Philox(key=key, counter=[0, 0, index, 0]))


def draw_key(rng: np.random.Generator) -> np.ndarray:
    """Draw the key of a chain."""
    return rng.integers(0, np.iinfo(np.uint64).max, size=2, dtype=np.uint64, endpoint=True)


def side_generator(key: np.ndarray, number: int = 1) -> np.random.Generator:
    """Make a generator from the chain's key that overlaps none of its blocks, nor another one."""
    return np.random.Generator(np.random.Philox(key=key, counter=[0, 0, 0, number]))


def draw_seeds(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Draw noise seeds, non-negative int64 of the given shape."""
    return rng.integers(0, np.iinfo(np.int64).max, size=shape, dtype=np.int64)
