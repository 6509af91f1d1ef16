"""How many evaluations an estimator makes: as many as the standard error that is asked for needs.

The number is doubled until the estimate's own standard error is at most ``target_se``. Such a rule
prefers estimates whose error looks small, and weights of a long tail look least variable where the
tail was missed. It begins with `FEWEST` evaluations: in simulations with log-normal weights of
log-variance two, the rule then shifts the estimate by a tenth of its standard error, and by less
than a twentieth with log-variance one.

An error with two sources, the draws and the evaluations, is not reduced beyond the point where the
evaluations contribute half as much as the draws: without them it would be a tenth smaller. If the
draws' error alone exceeds the target, whatever the evaluations, they stop at its size.

Where the effective number of the terms is small and does not grow with theirs, their tail is so
long that further ones reduce no error.
"""

import math
from collections.abc import Iterator

from ...system.checks import check_positive
from ..posterior import Posterior

FEWEST, MOST = 1000, 16_000  # evaluations with a target
MOST_WITHOUT_TARGET = 10_000
DOMINANT = 1.5  # ratio of errors at which the evaluations are to blame
# The effective number of terms below which they have no error to speak of, and its growth by twice
# as many, at least.
FEW, GROWTH = 10.0, 1.25
RATIO = 0.5  # of the evaluations' error to that of the draws, below which more hardly help


def check_target(target_se: float | None) -> None:
    """Raise a `ModelError` unless ``target_se`` is a positive number or None."""
    if target_se is not None:
        check_positive("target_se", target_se)


def totals(posterior: Posterior, target_se: float | None) -> Iterator[int]:
    """Totals after which an estimator looks at its error; without a target, only one.

    That one is the number of draws, within 1000 to 10 000.
    """
    if target_se is None:
        yield min(max(posterior.log_density.size, FEWEST), MOST_WITHOUT_TARGET)
        return
    total = FEWEST
    while total < MOST:
        yield total
        total *= 2
    yield MOST


def is_small(
    target_se: float | None, se_draws: float, se_evaluations: float, ratio: float = RATIO
) -> bool:
    """Whether the error has reached the target, or further evaluations can hardly reduce it."""
    if target_se is None:
        return True
    se = math.hypot(se_draws, se_evaluations)
    return se <= target_se or se_evaluations <= ratio * se_draws


def stands_still(former: float, n_effective: float) -> bool:
    """Whether terms are worth few, and hardly more than the ``former`` half of them alone."""
    return n_effective < min(FEW, GROWTH * former)


def ratio_of_errors(target_se: float, se_draws: float) -> float:
    """The `ratio` of `is_small` if evaluations leave the draws' error as it is."""
    return RATIO if se_draws < target_se else 1.0


def shortfall(
    target_se: float | None, se_draws: float, se_evaluations: float, n_draws: int, remedy: str
) -> str:
    """Why an error exceeds the target, and what would help; empty if it does not exceed it.

    ``remedy`` is that for evaluations, of which the most have been made.
    """
    if target_se is None or math.hypot(se_draws, se_evaluations) <= target_se:
        return ""
    needed = n_draws * (1 + RATIO**2) * (se_draws / target_se) ** 2
    if se_evaluations > DOMINANT * se_draws or needed <= n_draws:
        return f"{se_evaluations:.2g} nats come from the evaluations: {remedy}"
    return (
        f"{se_draws:.2g} nats come from the draws: about {_rounded(needed)} instead of {n_draws} "
        "would do"
    )


def _rounded(number: float) -> int:
    """Upwards, to two digits."""
    scale = 10 ** max(math.floor(math.log10(number)) - 1, 0)
    return math.ceil(number / scale) * scale
