"""When the chains of a model end: after a number of draws, or when these are worth enough."""

import math
from typing import NamedTuple

from ...errors import ModelError
from ...system.checks import check_count, check_positive
from ..output.convergence import FEWEST, MAX_RHAT, Convergence
from .request import SamplingRequest

AUTO = "auto"
# Effective draws that `sample` makes unless it is told otherwise.
ENOUGH = 400.0
# Independent draws show nine tenths of their number, or two thirds if they are few, and in 99 of
# 100 cases an R-hat below 1 + 8 / n, for n draws in one chain or in four.
_SHOWN_SHARE, _SHOWN_RHAT = 0.5, 8.0


class Length(NamedTuple):
    """Draws of each chain after the warm-up, each the last of so many iterations."""

    draws: int
    thin: int = 1

    @property
    def n_iterations(self) -> int:
        """Iterations after the warm-up."""
        return self.draws * self.thin


def target_ess(until_ess: float | str | None, draws: int, chains: int) -> float | None:
    """Effective draws to reach with so many draws of each chain; None if none are asked for.

    Raises `ModelError` if so many draws cannot be worth that, or an argument is not as `sample`
    describes it.
    """
    if until_ess is None:
        return None
    check_count("draws", draws, 0)
    check_count("chains", chains, 1)
    if isinstance(until_ess, str) and until_ess == AUTO:
        return min(ENOUGH, _SHOWN_SHARE * chains * draws) if draws >= FEWEST else None
    until_ess = check_positive("until_ess", until_ess)
    if until_ess > chains * draws:
        raise ModelError(
            f"until_ess must be at most the number of draws that are kept, {chains} * {draws}, got "
            f"{until_ess:g}: give more draws"
        )
    return until_ess


def first_length(request: SamplingRequest) -> Length:
    """The length after which chains end, or are looked at for the first time."""
    return Length(request.draws, request.thin)


def is_enough(request: SamplingRequest, found: Convergence | None) -> bool:
    """Whether draws are worth what the user asked for."""
    if request.until_ess is None:
        return True
    most = MAX_RHAT
    if request.doubles_thin:
        most = max(most, 1.0 + _SHOWN_RHAT / (request.chains * request.draws))
    return found is not None and found.reaches(request.until_ess, most)


def shows(request: SamplingRequest, ess: float) -> bool:
    """Whether the draws of a run, if independent, would show so many effective draws."""
    return not request.doubles_thin or ess <= _SHOWN_SHARE * request.chains * request.draws


def expected_iterations(
    request: SamplingRequest, length: Length, found: Convergence | None
) -> float:
    """Iterations of each chain by which draws will be worth ``until_ess``, which must be a number.

    As many as make effective draws, which are proportional to them.
    """
    least_ess = 0.0 if found is None else found.least_ess
    return length.n_iterations * (request.until_ess or 0.0) / max(least_ess, 1.0)


def next_length(
    request: SamplingRequest, length: Length, found: Convergence | None, seconds: float
) -> Length | None:
    """The length to which chains go on that have taken so many CPU seconds; None if they end.

    Either there are half as many draws again, or each draw stands for twice as many iterations.
    """
    if is_enough(request, found) or request.max_draws is None:
        return None
    if request.doubles_thin:
        longer = length._replace(thin=2 * length.thin)
        is_short = longer.n_iterations <= request.max_draws
        return longer if is_short and 2.0 * seconds <= request.seconds else None
    draws = min(request.max_draws, length.draws + math.ceil(length.draws / 2))
    return length._replace(draws=draws) if draws > length.draws else None
