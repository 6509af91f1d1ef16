"""Outcomes of an evaluation: rows that are missing, and failure codes with their descriptions."""

import warnings
from collections import Counter
from typing import Any

import numpy as np

from pymc_statespace_filters.compiler.native.jit import inline_always
from pymc_statespace_filters.errors import FilterWarning

# Fewer effective particles than this, and one of them decides the estimate.
COLLAPSED = 3.0

NONE = 0
NO_FINITE_MEMBER = 1
COVARIANCE_NOT_POSITIVE = 2
ZERO_WEIGHTS = 3
NO_PROCESS_NOISE = 4
GRID_TOO_LARGE = 5
OUT_OF_MEMORY = 6

FAILURES: dict[int, str] = {
    NONE: "no failure",
    NO_FINITE_MEMBER: "every member or particle became infinite or NaN",
    COVARIANCE_NOT_POSITIVE: "a covariance of the system or the forecast is not positive definite",
    ZERO_WEIGHTS: "the observation has probability zero for every member or particle",
    NO_PROCESS_NOISE: "the process noise vanished where the state may be",
    GRID_TOO_LARGE: "the grid would need more than 8192 points, for the noise or the sensor is so "
    "fine beside the spread of the state, or the equations are so far from smooth",
    OUT_OF_MEMORY: "there was not enough memory for the members",
}


@inline_always
def is_missing(observed, j):
    """Whether observation j is wholly missing."""
    for i in range(observed.shape[1]):
        if not np.isnan(observed[j, i]):
            return False
    return True


def warn_about(filter: Any, health: np.ndarray, *, stacklevel: int = 3) -> None:
    """Warn once of failures and collapse in some evaluations, given their health (n, 3)."""
    failed = health[:, 1] != 0
    if failed.any():
        reasons = Counter(FAILURES[int(code)] for code in health[failed, 1])
        listed = "; ".join(f"{count} times {reason}" for reason, count in reasons.most_common())
        warnings.warn(
            f"{filter} gave -inf in {failed.sum()} of {len(health)} evaluations: {listed}",
            FilterWarning,
            stacklevel=stacklevel,
        )
    collapsed = ~failed & (health[:, 0] < COLLAPSED)
    if collapsed.any():
        warnings.warn(
            f"{filter}: at some observation fewer than {COLLAPSED:g} particles carried all the "
            f"weight, in {collapsed.sum()} of {len(health)} evaluations (smallest effective "
            f"number {health[~failed, 0].min():.3g}). The log-likelihood may be tens of nats too "
            f"low, by a different amount for every seed; more particles lessen this only slowly. "
            f"EKF() and EnKF(n, likelihood='gaussian') do not collapse, but have a bias of their "
            f"own where the state is not Gaussian.",
            FilterWarning,
            stacklevel=stacklevel,
        )
