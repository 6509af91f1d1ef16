"""Outcomes of an evaluation: why a filter failed, too few particles, and rows that are missing."""

from collections import Counter

import numpy as np

from ..compiler.native.jit import inline_always
from ..compiler.native.outcome_code import OutcomeCode

# Of larger states and covariances the density is not a number, or that of everything is zero.
LARGEST = 1e150

# Fewer effective particles than this behind a term, and one of them decides it.
COLLAPSED = 3.0


def _not_semidefinite(name: str) -> tuple[str, str]:
    return (
        f"{name} is not positive semidefinite at these parameters",
        f"Write {name} so that it always is, for example a variance as s**2 with the prior "
        f"pm.HalfNormal for s",
    )


class Failure(OutcomeCode):
    """Why an evaluation has no finite likelihood; compiled code uses the integers below."""

    RAISED = -2, "the model raised an exception"
    NOT_A_NUMBER = -1, "the log-density is NaN or plus infinity"
    NONE = 0, "no failure"
    STATE_NOT_FINITE = (
        1,
        "the state overflowed or became NaN",
        "If the equations are stable there, make their steps shorter; if not, give a prior that "
        "excludes such parameters",
    )
    COVARIANCE_NOT_POSITIVE = (
        2,
        "by rounding errors, the covariance of the predicted state is not positive definite",
        "If the equations change much within a step, make the steps shorter; otherwise use units "
        "in which states and observables have similar sizes, or a larger observation_noise",
    )
    ZERO_DENSITY = (
        3,
        "the observation has density zero wherever this filter has the state",
        "Check the observation, and whether the observation noise is wide enough",
    )
    NO_PROCESS_NOISE = 4, "the process noise vanished where the state may be"
    GRID_TOO_LARGE = (
        5,
        "the density would need more than 8192 points, for the noise or the sensor is so fine "
        "beside the spread of the state",
        "A larger tolerance, such as GridFilter(tolerance=1e-3), needs fewer",
    )
    OUT_OF_MEMORY = 6, "there was not enough memory for the members", "Use fewer members"
    TOO_FAR = (
        7,
        "the observation lies where the density of the state is below 1e-265, which this filter "
        "does not resolve",
        "Check the observation",
    )
    INITIAL_COV = 8, *_not_semidefinite("initial_cov")
    PROCESS_NOISE = 9, *_not_semidefinite("process_noise")
    OBSERVATION_NOISE = 10, *_not_semidefinite("observation_noise")
    OBSERVATION_UNDEFINED = (
        11,
        "the observation has no density wherever this filter has the state: its mean is infinite "
        "or NaN, its noise has variance zero, or a parameter of its distribution is outside its "
        "domain, such as a negative mean of a Poisson distribution",
        "If a sensor has no noise, give it some; otherwise write the observation so that it is "
        "defined at every state, for example with pt.softplus(x[0]), which is positive and does "
        "not overflow",
    )
    INVALID_PROBABILITY = (
        12,
        "a probability of process_dist or initial_dist is outside of 0 to 1, or those of the "
        "categories do not add up to one",
        "Write probabilities so that they always are such, for example with pm.math.sigmoid, or "
        "give them Beta and Dirichlet priors",
    )
    SINGULAR = (
        13,
        "the covariance of the predicted observation is singular (stochastic singularity)",
        "Give the sensors noise, or let as many independent noises reach the observables as there "
        "are sensors without noise; if they do, give an initial_cov of at most 1e8 times "
        "observation_noise, and use units in which states and observables have similar sizes",
    )
    EXCEPTION = 14, "a function of the filter raised an exception, which Python wrote to stderr"

    @property
    def has_row(self) -> bool:
        """Whether it belongs to a row of the record, not to parameters or the machine."""
        return self not in _WITHOUT_ROW

    @property
    def is_far(self) -> bool:
        """Whether the data lie far from the states, not in the equations or their parameters."""
        return self in (Failure.ZERO_DENSITY, Failure.TOO_FAR)


_WITHOUT_ROW = (
    Failure.INITIAL_COV, Failure.PROCESS_NOISE, Failure.OBSERVATION_NOISE, Failure.OUT_OF_MEMORY
)  # fmt: skip

(
    RAISED, NOT_A_NUMBER, NONE, STATE_NOT_FINITE, COVARIANCE_NOT_POSITIVE, ZERO_DENSITY,
    NO_PROCESS_NOISE, GRID_TOO_LARGE, OUT_OF_MEMORY, TOO_FAR, INITIAL_COV, PROCESS_NOISE,
    OBSERVATION_NOISE, OBSERVATION_UNDEFINED, INVALID_PROBABILITY, SINGULAR, EXCEPTION,
) = map(int, Failure)  # fmt: skip


def why_zero(failures: Counter[Failure], n_points: int) -> str:
    """Why the likelihood is zero at points of the prior, counted by reason, and what to do."""
    narrow = "narrow the priors to plausible values"
    if not failures:
        return narrow
    (failure, count), *_ = failures.most_common(1)
    cures = [failure.cure] if failure.cure else []
    if failure.is_far or not cures:
        cures.append(narrow.capitalize())
    reason = f"in {count} of {n_points} evaluations {failure.message}"
    return ". ".join([reason, *cures])


@inline_always
def is_missing(observed, j):
    """Whether observation j is wholly missing."""
    for i in range(observed.shape[1]):
        if not np.isnan(observed[j, i]):
            return False
    return True
