"""Outcomes of an evaluation: rows that are missing, and failure codes with their descriptions."""

import numpy as np

from ..compiler.native.jit import inline_always

# Fewer effective particles than this behind a term, and one of them decides it.
COLLAPSED = 3.0

NONE = 0
NO_FINITE_MEMBER = 1
COVARIANCE_NOT_POSITIVE = 2
ZERO_WEIGHTS = 3
NO_PROCESS_NOISE = 4
GRID_TOO_LARGE = 5
OUT_OF_MEMORY = 6
TOO_FAR = 7

FAILURES: dict[int, str] = {
    NONE: "no failure",
    NO_FINITE_MEMBER: "every member or particle became infinite or NaN",
    COVARIANCE_NOT_POSITIVE: "a covariance of the system or the forecast is not positive definite",
    ZERO_WEIGHTS: "the observation has probability zero for every member or particle",
    NO_PROCESS_NOISE: "the process noise vanished where the state may be",
    GRID_TOO_LARGE: "the density would need more than 8192 points, for the noise or the sensor is "
    "so fine beside the spread of the state; a larger tolerance, such as "
    "GridFilter(tolerance=1e-3), needs fewer",
    TOO_FAR: "the observation lies where the density of the state is below 1e-265, which this "
    "filter does not resolve",
    OUT_OF_MEMORY: "there was not enough memory for the members",
}


@inline_always
def is_missing(observed, j):
    """Whether observation j is wholly missing."""
    for i in range(observed.shape[1]):
        if not np.isnan(observed[j, i]):
            return False
    return True
