"""Settings of the DRAM step: frozen, validated once."""

import math
import numbers
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.sampling.adaptation import (
    AdaptationSettings,
    AdaptationState,
    adapt_by_blocks,
    adapt_continuously,
)

ADAPTATIONS: dict[str, Callable[..., AdaptationState]] = {
    "chain": adapt_by_blocks,
    "continuous": adapt_continuously,
}


@dataclass(frozen=True)
class DRAMSettings:
    """Settings of delayed rejection adaptive Metropolis.

    Attributes
    ----------
    stages : tuple of int
        Stages while tuning, and afterwards.
    stage_scale : float
        Standard deviation of each stage relative to the one before.
    adaptation : str
        A key of ``ADAPTATIONS``.
    adapt_every : int
        Iterations in a block of warm-up.
    refresh_noise : bool
        Whether every proposal has noise of its own.
    """

    stages: tuple[int, int]
    stage_scale: float
    adaptation: str
    adapt_every: int
    refresh_noise: bool

    def __post_init__(self) -> None:
        scale = self.stage_scale
        if not _is_real(scale) or not 0.0 < scale < math.inf:
            raise ModelError(f"stage_scale={scale!r}: expected a positive number")
        if not isinstance(self.adaptation, str) or self.adaptation not in ADAPTATIONS:
            raise ModelError(
                f"adaptation={self.adaptation!r}: expected one of "
                f"{', '.join(map(repr, ADAPTATIONS))}"
            )
        if not _is_count(self.adapt_every) or self.adapt_every < 4:
            raise ModelError(f"adapt_every={self.adapt_every!r}: expected an integer, at least 4")
        if not isinstance(self.refresh_noise, bool | np.bool_):
            raise ModelError(f"refresh_noise={self.refresh_noise!r}: expected True or False")

    @property
    def adapt(self) -> Callable[..., AdaptationState]:
        """The adaptation's function."""
        return ADAPTATIONS[self.adaptation]

    @property
    def adaptation_settings(self) -> AdaptationSettings:
        """What that function reads."""
        return AdaptationSettings(int(self.adapt_every))


def checked_proposal_cov(proposal_cov: object, dim: int) -> np.ndarray:
    """Check a proposal covariance given by the user.

    Parameters
    ----------
    proposal_cov : array_like, shape (d, d)
    dim : int
        d.

    Returns
    -------
    ndarray of float64, shape (d, d)

    Raises
    ------
    ModelError
        If it is not a symmetric positive definite matrix of numbers, d by d.
    """
    expected = f"expected a symmetric positive definite {dim} x {dim} matrix"
    try:
        cov = np.array(proposal_cov, dtype=np.float64)
    except (TypeError, ValueError):
        raise ModelError(f"proposal_cov={proposal_cov!r}: {expected}") from None
    if cov.shape != (dim, dim):
        raise ModelError(f"proposal_cov has the shape {cov.shape}: {expected}")
    if not np.isfinite(cov).all() or not _is_symmetric(cov):
        raise ModelError(f"proposal_cov={cov.tolist()}: {expected}")
    try:
        np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        raise ModelError(f"proposal_cov={cov.tolist()}: {expected}") from None
    return 0.5 * (cov + cov.T)


def stage_pair(stages: object) -> tuple[int, int]:
    """Turn an int, or a pair, into the stages while tuning and afterwards.

    Raises
    ------
    ModelError
        If it is neither, or a number is below 1.
    """
    pair = (stages, stages) if _is_count(stages) else stages
    if (
        not isinstance(pair, tuple | list)
        or len(pair) != 2
        or not all(_is_count(k) and k >= 1 for k in pair)
    ):
        raise ModelError(
            f"stages={stages!r}: expected an integer, at least 1, or a pair of them "
            "(while tuning, afterwards)"
        )
    return int(pair[0]), int(pair[1])


def _is_symmetric(cov: np.ndarray) -> bool:
    return np.allclose(cov, cov.T, rtol=1e-8, atol=1e-12 * np.abs(cov).max(initial=0.0))


def _is_count(value: object) -> bool:
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def _is_real(value: object) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)
