"""Whitening of draws by their mean and the Cholesky factor of their covariance.

Chib and Jeliazkov's plan and both kinds of bridge sampling need log-densities at draws of N(m, C),
with the moments of each half of the chains. In a set of estimators they are evaluated once. Points
are made in blocks, each with its own random numbers. Every estimator therefore gets the same first
points, and an estimate does not depend on which estimators run beside it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import ModelError
from ..posterior import Posterior

Array = NDArray[np.float64]

BLOCK = 500  # points


class Whitening(NamedTuple):
    """Coordinates z in which draws have mean zero and covariance one: x = mean + chol z."""

    mean: Array  # (k,)
    chol: Array  # (k, k), lower

    def unconstrained(self, z: Array) -> Array:
        """Points x (m, k) of whitened points z (m, k)."""
        return self.mean + z @ self.chol.T

    def whitened(self, x: Array) -> Array:
        """Whitened points of x (m, k)."""
        # SciPy's triangular solver starts BLAS threads, which takes milliseconds at any size.
        return (x - self.mean) @ np.linalg.inv(self.chol).T


def moments(draws: Array) -> Whitening:
    """Mean and lower Cholesky factor of the covariance of draws (..., k).

    Raises `ModelError` if the draws do not vary in every direction.
    """
    k = draws.shape[-1]
    flat = draws.reshape(-1, k)
    return _factored(flat.mean(axis=0), np.cov(flat, rowvar=False).reshape(k, k), len(flat))


def moments_within_chains(draws: Array) -> Whitening:
    """Mean of draws (chain, draw, k), and the factor of their covariance within chains.

    Between-chain variance is excluded: with chains in separate modes it would hide the widths of
    the modes. Raises `ModelError` if the draws do not vary in every direction.
    """
    about_mean = (draws - draws.mean(axis=1, keepdims=True)).reshape(-1, draws.shape[-1])
    count = len(about_mean)
    return _factored(draws.mean(axis=(0, 1)), about_mean.T @ about_mean / count, count)


def _factored(mean: Array, covariance: Array, count: int) -> Whitening:
    try:
        return Whitening(mean, np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        raise ModelError(
            "the draws of idata must vary in every direction, got a singular covariance of "
            f"{count} draws of {len(mean)} unconstrained parameters"
        ) from None


class NormalProposals:
    """Draws of N(mean, C) with the moments of a posterior's draws, and their log-densities."""

    def __init__(self, posterior: Posterior, seed: Sequence[int]) -> None:
        self.moments: Whitening = moments(posterior.draws)
        self._posterior, self._seed = posterior, seed
        self._blocks: list[tuple[Array, Array]] = []

    def first(self, count: int) -> tuple[Array, Array]:
        """The first points (count, k) and their log-densities (count,).

        What is lacking is evaluated, in whole blocks; a noisy likelihood takes fresh noise.
        """
        lacking = range(len(self._blocks), -(-count // BLOCK))
        streams = [np.random.default_rng([*self._seed, block]) for block in lacking]
        shape = BLOCK, len(self.moments.mean)
        for rng in streams:
            points = self.moments.unconstrained(rng.standard_normal(shape))
            self._blocks.append((points, self._posterior.evaluate(points, rng)))
        points, values = (np.concatenate(parts) for parts in zip(*self._blocks, strict=True))
        return points[:count], values[:count]


def normal_proposals(
    posterior: Posterior, rng: np.random.Generator
) -> tuple[NormalProposals, NormalProposals]:
    """Proposals fitted to each of the halves that are averaged (`Posterior.halves`).

    They are those of all estimators that run on this posterior, if it has a seed for them;
    otherwise new ones of `rng`.
    """
    seed = posterior.shared_seed
    if seed is None:
        return _of_halves(posterior, rng.integers(2**63, size=2).tolist())
    if "normal_proposals" not in posterior.shared:
        posterior.shared["normal_proposals"] = _of_halves(posterior, seed)
    found: tuple[NormalProposals, NormalProposals] = posterior.shared["normal_proposals"]
    return found


def _of_halves(
    posterior: Posterior, seed: Sequence[int]
) -> tuple[NormalProposals, NormalProposals]:
    first, second = posterior.halves()
    return NormalProposals(first, [*seed, 0]), NormalProposals(second, [*seed, 1])
