"""When the chains of a model end: after a number of draws, or when these are worth enough."""

import math
from typing import NamedTuple

from ..output.convergence import Convergence
from .request import SamplingRequest


class Length(NamedTuple):
    """Draws of each chain after the warm-up, each the last of so many iterations."""

    draws: int
    thin: int = 1

    @property
    def n_iterations(self) -> int:
        """Iterations after the warm-up."""
        return self.draws * self.thin


def first_length(request: SamplingRequest) -> Length:
    """The length after which chains end, or are looked at for the first time."""
    return Length(request.draws, request.thin)


def is_enough(request: SamplingRequest, found: Convergence | None) -> bool:
    """Whether draws are worth what the user asked for."""
    return request.until_ess is None or (found is not None and found.reaches(request.until_ess))


def next_length(
    request: SamplingRequest, length: Length, found: Convergence | None, seconds: float
) -> Length | None:
    """The length to which chains go on that have taken so many seconds; None if they end.

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


def remedy_of(request: SamplingRequest, length: Length, ways: str) -> str:
    """What to do if chains ended before their draws were worth enough; ``ways`` make them mix."""
    if not request.doubles_thin:
        return f"give a larger max_draws, {ways}"
    if 2 * length.n_iterations > (request.max_draws or 0):
        return f"give a larger max_draws than {request.max_draws}, {ways}"
    return (
        f"the run ended as twice as many would take longer than its {request.seconds:.0f} s: make "
        f"more with psf.sample(continue_from=idata), {ways}"
    )
