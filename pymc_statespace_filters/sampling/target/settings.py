"""Settings of DRAM: frozen, validated once."""

import math
import numbers
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

from ...errors import ModelError
from ...pymc_model.inspection import is_filter
from ...system.checks import check_count, is_integer

ADAPTATIONS = ("chain", "continuous")


@dataclass(frozen=True)
class RandomWalkSettings:
    """Settings of the random walk of `sample`, `sample_dram` and `run_models`.

    The step method `DRAM` describes the algorithm.

    Parameters
    ----------
    stages, stage_scale, adaptation, adapt_every, refresh_noise, correlation, screen, screen_power
        As of `DRAM`.
    proposal_cov : array_like, shape (d, d), optional
        Covariance of the first proposals, on the unconstrained space, in the order of the model's
        free variables. Default: found by the search for starts, or else the prior's.

    Raises
    ------
    ModelError
        If an argument is not as described.

    Notes
    -----
    Settings are equal if their values are. ``stages`` becomes a pair, ``correlation=0`` None, and
    ``proposal_cov`` rows of numbers.

    Examples
    --------
    >>> RandomWalkSettings.of({"stages": 1}).stages
    (1, 1)
    """

    stages: Any = (2, 1)
    stage_scale: float = 0.2
    adaptation: str = "chain"
    adapt_every: int = 100
    refresh_noise: bool = True
    correlation: float | None = None
    screen: Any = None
    screen_power: float = 0.5
    proposal_cov: Any = None

    def __post_init__(self) -> None:
        for field in fields(self):  # equal settings must have equal representations
            if isinstance(value := getattr(self, field.name), np.generic):
                object.__setattr__(self, field.name, value.item())
        object.__setattr__(self, "stages", _stage_pair(self.stages))
        scale = self.stage_scale
        if not _is_real(scale) or not 0.0 < scale < math.inf:
            raise ModelError(f"stage_scale must be a positive number, got {scale!r}")
        if not isinstance(self.adaptation, str) or self.adaptation not in ADAPTATIONS:
            raise ModelError(
                f"adaptation must be one of {', '.join(map(repr, ADAPTATIONS))}, got "
                f"{self.adaptation!r}"
            )
        check_count("adapt_every", self.adapt_every, 4)
        if not isinstance(self.refresh_noise, bool | np.bool_):
            raise ModelError(f"refresh_noise must be True or False, got {self.refresh_noise!r}")
        if self.screen is not None and not is_filter(self.screen):
            raise ModelError(
                f"screen must be a filter such as psf.EKF(), or None, got {self.screen!r}"
            )
        power = self.screen_power
        if not _is_real(power) or not 0.0 < power <= 1.0:
            raise ModelError(f"screen_power must be a number in (0, 1], got {power!r}")
        if _is_real(self.correlation) and self.correlation == 0.0:  # fresh noise
            object.__setattr__(self, "correlation", None)
        if self.correlation is not None:
            self._check_correlation(self.correlation)
        if self.proposal_cov is not None:
            cov = checked_proposal_cov(self.proposal_cov)
            object.__setattr__(self, "proposal_cov", tuple(map(tuple, cov.tolist())))

    @classmethod
    def of(cls, kernel: Mapping[str, Any] | Self | None) -> Self:
        """The settings that a user gives as ``kernel=``; None is the default of each."""
        if isinstance(kernel, cls):
            return kernel
        known = [field.name for field in fields(cls)]
        if not isinstance(kernel, Mapping | None) or not set(kernel or ()) <= set(known):
            raise ModelError(
                f"kernel must be a mapping of some of {', '.join(known)}, or None, got {kernel!r}"
            )
        return cls(**(kernel or {}))

    def _check_correlation(self, correlation: float) -> None:
        if not _is_real(correlation) or not 0.0 < correlation < 1.0:
            raise ModelError(
                f"correlation must be a number between 0 and 1, or None, got {correlation!r}"
            )
        given = f"with correlation={correlation!r}"
        if self.stages != (1, 1):
            raise ModelError(
                f"stages must be 1 {given}, got {self.stages}: the noise of a second proposal "
                "would depend on that of the first, and the densities of the noise would not "
                "cancel in the acceptance probability"
            )
        if not self.refresh_noise:
            raise ModelError(f"refresh_noise must be True {given}, got False")
        if self.screen is not None and self.screen.noisy:
            raise ModelError(
                f"screen must be a filter without noise {given}, got {self.screen!r}: its "
                "estimates at the two points would not be compared at the same noise"
            )


def checked_proposal_cov(proposal_cov: object, dim: int | None = None) -> np.ndarray:
    """Return the user's proposal covariance as a symmetric positive definite matrix.

    Raises `ModelError` if it is not a symmetric positive definite matrix of numbers, ``dim`` by
    ``dim`` if given.
    """
    size = "" if dim is None else f" {dim} x {dim}"
    expected = f"proposal_cov must be a symmetric positive definite{size} matrix, got"
    try:
        cov = np.array(proposal_cov, dtype=np.float64)
    except (TypeError, ValueError):
        raise ModelError(f"{expected} {proposal_cov!r}") from None
    if cov.ndim != 2 or cov.shape != (len(cov) if dim is None else dim,) * 2:
        raise ModelError(f"{expected} shape {cov.shape}")
    tolerance = {"rtol": 1e-8, "atol": 1e-12 * np.abs(cov).max(initial=0.0)}
    if not np.isfinite(cov).all() or not np.allclose(cov, cov.T, **tolerance):
        raise ModelError(f"{expected} {cov.tolist()}")
    try:
        np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        raise ModelError(f"{expected} {cov.tolist()}") from None
    return 0.5 * (cov + cov.T)


def _stage_pair(stages: object) -> tuple[int, int]:
    """Turn an int, or a pair, into the stages while tuning and afterwards."""
    pair = (stages, stages) if is_integer(stages) else stages
    if (
        not isinstance(pair, tuple | list)
        or len(pair) != 2
        or not all(is_integer(k) and k >= 1 for k in pair)
    ):
        raise ModelError(
            "stages must be an integer of at least 1, or a pair of them (while tuning, "
            f"afterwards), got {stages!r}"
        )
    return int(pair[0]), int(pair[1])


def _is_real(value: object) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)
