"""The first points of sub-models: which are within reach, and better proposals of these.

A proposal that follows from poor draws may miss its sub-model, so that few points tell nothing
about the evidence but that it is not below what they have seen. Before a sub-model is left as it
is, its proposal is fitted again, unless it would be out of reach by a generous bound.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from .proposals import Proposal
from .submodel_density import Array
from .submodel_evidence import Sampler, Weighted

N_SCREENED = 25  # points of every sub-model
MOST_SCREENED = 20_000  # points of all sub-models that are drawn again, unless 25 each are more
FEWEST_EFFECTIVE = 3.0  # effective points that say something about the evidence
REACH = 10.0  # nats below the most probable sub-model, beyond which one is left as it is
N_PILOT, GOOD = 200, 0.25  # points that judge a proposal; effective points per point that suffice
N_REFITS = 5

Announce = Callable[[str, int], None]


def screened(
    proposals: Sequence[Proposal],
    log_prior: Array,
    sampler: Sampler,
    rng: np.random.Generator,
    highest: float = -np.inf,
) -> tuple[list[Weighted], NDArray[np.bool_]]:
    """A few points of each sub-model, and whether it is within reach of the best (S,).

    The height of the best is at least ``highest``.
    """
    found = sampler.draw(proposals, [N_SCREENED] * len(proposals))
    before: list[list[Weighted]] = [[] for _ in found]
    most, count = np.array([_at_most(one) for one in found]), N_SCREENED
    for _ in range(N_REFITS):
        within = _within_reach(found, most, log_prior, highest)
        again = [i for i in np.flatnonzero(within) if is_worthless(found[i])]
        if not again:
            break
        count = max(N_SCREENED, min(2 * count, MOST_SCREENED // len(again)))
        refitted = [found[i].refitted(rng, before[i]) for i in again]
        for i, one in zip(again, sampler.draw(refitted, [count] * len(again)), strict=True):
            before[i].append(found[i])
            found[i] = one
            most[i] = max(most[i], _at_most(one))
    return found, _within_reach(found, most, log_prior, highest)


def is_worthless(points: Weighted) -> bool:
    """Whether the weights are so few that they say nothing about an evidence but its order."""
    return points.n_effective < FEWEST_EFFECTIVE


def _within_reach(
    found: Sequence[Weighted], most: Array, log_prior: Array, highest: float
) -> NDArray[np.bool_]:
    height = log_prior + [one.mean.value for one in found]
    return np.asarray(log_prior + most > max(height.max(), highest) - REACH)


def _at_most(points: Weighted) -> float:
    """What the log-evidence may well be at most.

    That is as far above its estimate as the largest weight is above the middle one: also points on
    a slope, beside all that matters, may have weights that are not few.
    """
    value, largest = points.mean.value, float(points.log_weights.max())
    if largest == -np.inf:
        return value
    return value + largest - float(np.median(points.log_weights))


def improved(
    proposals: Sequence[Proposal],
    sampler: Sampler,
    rng: np.random.Generator,
    announce: Announce,
    count: int = N_PILOT,
    good: float = GOOD,
) -> list[Weighted]:
    """Proposals that are fitted again until they are good, each with the points that judged it.

    Each is judged by ``count`` points, and ``good`` with so many effective points per point.
    """
    current = list(proposals)
    best: dict[int, Weighted] = {}
    before: list[list[Weighted]] = [[] for _ in current]
    pending = list(range(len(current)))
    for _ in range(N_REFITS + 1):
        announce("proposals", count * len(pending))
        drawn = sampler.draw([current[i] for i in pending], [count] * len(pending))
        poor = []
        for i, one in zip(pending, drawn, strict=True):
            if i not in best or one.efficiency > best[i].efficiency:
                best[i] = one
            if one.efficiency < good:
                current[i] = one.refitted(rng, before[i])
                before[i].append(one)
                poor.append(i)
        pending = [i for i in poor if current[i] is not before[i][-1].proposal]
        if not pending:
            break
    return [best[i] for i in range(len(current))]
