"""Whitening of draws by their mean and the Cholesky factor of their covariance."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import ModelError

Array = NDArray[np.float64]


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

    Raises
    ------
    ModelError
        If the draws do not vary in every direction.
    """
    k = draws.shape[-1]
    flat = draws.reshape(-1, k)
    return _factored(flat.mean(axis=0), np.cov(flat, rowvar=False).reshape(k, k), len(flat))


def moments_within_chains(draws: Array) -> Whitening:
    """Mean of draws (chain, draw, k), and the factor of their covariance within chains.

    Between-chain variance is excluded: with chains in separate modes it would hide the widths of
    the modes.

    Raises
    ------
    ModelError
        If the draws do not vary in every direction.
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
