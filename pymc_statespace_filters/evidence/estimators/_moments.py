"""Location and scale of draws, by which proposals are placed and spaces are standardised."""

import numpy as np
from numpy.typing import NDArray

from pymc_statespace_filters.errors import ModelError

Array = NDArray[np.float64]


def moments(draws: Array) -> tuple[Array, Array]:
    """Mean (k,) and lower Cholesky factor (k, k) of the covariance of draws (..., k).

    Raises
    ------
    ModelError
        If the draws do not vary in every direction.
    """
    k = draws.shape[-1]
    flat = draws.reshape(-1, k)
    try:
        chol = np.linalg.cholesky(np.cov(flat, rowvar=False).reshape(k, k))
    except np.linalg.LinAlgError:
        raise ModelError(
            "idata must hold draws that vary in every direction; the covariance of "
            f"{len(flat)} draws of {k} unconstrained parameters is singular"
        ) from None
    return flat.mean(axis=0), chol
