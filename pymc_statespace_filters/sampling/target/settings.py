"""Settings of the DRAM step: frozen, validated once."""

import math
import numbers
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.pymc_model.inspection import is_filter
from pymc_statespace_filters.system.checks import is_integer

ADAPTATIONS = ("chain", "continuous")


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
        One of ``ADAPTATIONS``.
    adapt_every : int
        Iterations in a block of warm-up.
    refresh_noise : bool
        Whether every proposal has noise of its own.
    correlation : float or None
        Of the noise of a proposal with that of the current point, if not drawn afresh.
    screen : filter or None
        Whose likelihood stands in for that of the model until a move has been made on it.
    screen_power : float
        By which that likelihood enters.
    """

    stages: Any = (2, 1)
    stage_scale: float = 0.2
    adaptation: str = "chain"
    adapt_every: int = 100
    refresh_noise: bool = True
    correlation: float | None = None
    screen: Any = None
    screen_power: float = 0.5

    @classmethod
    def of(cls, arguments: Mapping[str, Any]) -> Self:
        """Make settings of arguments by name, as a user gave them.

        Raises
        ------
        TypeError
            If there is no such setting.
        """
        names = [field.name for field in fields(cls)]
        if unknown := [name for name in arguments if name not in names]:
            raise TypeError(
                f"unexpected keyword argument {unknown[0]!r}: the settings of DRAM are "
                f"proposal_cov, {', '.join(names)}"
            )
        return cls(**arguments)

    def __post_init__(self) -> None:
        for field in fields(self):  # settings that are equal shall look equal
            if isinstance(value := getattr(self, field.name), np.generic):
                object.__setattr__(self, field.name, value.item())
        object.__setattr__(self, "stages", stage_pair(self.stages))
        scale = self.stage_scale
        if not _is_real(scale) or not 0.0 < scale < math.inf:
            raise ModelError(f"stage_scale={scale!r}: expected a positive number")
        if not isinstance(self.adaptation, str) or self.adaptation not in ADAPTATIONS:
            raise ModelError(
                f"adaptation={self.adaptation!r}: expected one of "
                f"{', '.join(map(repr, ADAPTATIONS))}"
            )
        if not is_integer(self.adapt_every) or self.adapt_every < 4:
            raise ModelError(f"adapt_every={self.adapt_every!r}: expected an integer, at least 4")
        if not isinstance(self.refresh_noise, bool | np.bool_):
            raise ModelError(f"refresh_noise={self.refresh_noise!r}: expected True or False")
        if self.screen is not None and not is_filter(self.screen):
            raise ModelError(
                f"screen={self.screen!r}: expected a filter such as psf.EKF(), or None"
            )
        power = self.screen_power
        if not _is_real(power) or not 0.0 < power <= 1.0:
            raise ModelError(f"screen_power={power!r}: expected a number above 0, at most 1")
        if _is_real(self.correlation) and self.correlation == 0.0:  # noise drawn anew
            object.__setattr__(self, "correlation", None)
        if self.correlation is not None:
            self._check_correlation(self.correlation)

    def _check_correlation(self, correlation: float) -> None:
        given = f"correlation={correlation!r}"
        if not _is_real(correlation) or not 0.0 < correlation < 1.0:
            raise ModelError(f"{given}: expected a number between 0 and 1, or None")
        if self.stages != (1, 1):
            raise ModelError(
                f"{given} needs stages=1, got stages={self.stages}: the noise of a second proposal "
                "would depend on that of the first, and the densities of the noise would not "
                "cancel in the probability of accepting it"
            )
        if not self.refresh_noise:
            raise ModelError(f"{given} moves the noise, which refresh_noise=False holds")
        if self.screen is not None and self.screen.noisy:
            raise ModelError(
                f"{given} needs a screen without noise, got screen={self.screen!r}: two estimates "
                "with noise of their own would not be compared at the same noise"
            )


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
    pair = (stages, stages) if is_integer(stages) else stages
    if (
        not isinstance(pair, tuple | list)
        or len(pair) != 2
        or not all(is_integer(k) and k >= 1 for k in pair)
    ):
        raise ModelError(
            f"stages={stages!r}: expected an integer, at least 1, or a pair of them "
            "(while tuning, afterwards)"
        )
    return int(pair[0]), int(pair[1])


def _is_symmetric(cov: np.ndarray) -> bool:
    return np.allclose(cov, cov.T, rtol=1e-8, atol=1e-12 * np.abs(cov).max(initial=0.0))


def _is_real(value: object) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)
