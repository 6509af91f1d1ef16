"""All sub-models: evaluations go to those that matter, by successive halving.

A few points of each say which sub-models are out of reach. The proposals of the others are fitted
again until their weights are good. Then points are added where they reduce the error of an
inclusion most (Neyman 1934).
"""

from collections.abc import Callable, Sequence

import numpy as np

from .candidates import Candidates
from .density import Array, Sets
from .doubts import check_finite
from .estimates import Sampler, Weighted
from .inclusion import InclusionPrior
from .probabilities import Probabilities
from .proposals import Guide, Proposal
from .unused import Uses

N_SCREENED, N_POINTS = 25, 200  # points of each sub-model: of all, and of those within reach
REACH = 15.0  # nats below the most probable sub-model, beyond which one is left as it is
N_REFITS, GOOD = 5, 0.25  # most refits of a proposal; effective points per point that suffice
TARGET_SE = 0.005  # of an inclusion
MATTERS = 0.002  # influence of a sub-model on an inclusion, from which its weights must be good
MOST_POINTS = 50_000  # that are added to reach it
N_ROUNDS = 6

Announce = Callable[[str, int], None]


def estimate_all(
    sets: Sets,
    candidates: Candidates,
    prior: InclusionPrior,
    guide: Guide,
    uses: Uses,
    sampler: Sampler,
    rng: np.random.Generator,
    announce: Announce,
) -> list[Weighted]:
    """Points of all sub-models (S, K), enough for the probabilities of inclusion."""
    log_prior = prior.log_weight(sets)
    announce("all sub-models", N_SCREENED * len(sets))
    proposals = _proposals(sets, guide, uses, sampler)
    found = sampler.draw(proposals, [N_SCREENED] * len(sets))
    check_finite(found, candidates)
    chosen = _within_reach(found, log_prior)
    found = [one if chosen[i] else one.without_points() for i, one in enumerate(found)]
    better = improved([found[i] for i in np.flatnonzero(chosen)], sampler, rng, announce)
    for i, one in zip(np.flatnonzero(chosen), better, strict=True):
        found[i] = one
    return _until_certain(found, sets, log_prior, sampler, rng, announce)


def _proposals(sets: Sets, guide: Guide, uses: Uses, sampler: Sampler) -> list[Proposal]:
    """The proposals of sub-models, with unused variables where there are some."""
    unused = [uses.unused(one) for one in sets]
    found = [guide.proposal(one, blocks) for one, blocks in zip(sets, unused, strict=True)]
    doubtful = [i for i, one in enumerate(found) if one.unused.size]
    if doubtful:
        is_free = sampler.is_free([found[i] for i in doubtful])
        for i in np.compress(~is_free, doubtful):
            found[i] = guide.proposal(sets[i], np.zeros_like(unused[i]))
    return found


def _within_reach(found: Sequence[Weighted], log_prior: Array) -> np.ndarray:
    height = log_prior + [one.mean.value for one in found]
    return np.asarray(height > height.max() - REACH)


def improved(
    found: Sequence[Weighted], sampler: Sampler, rng: np.random.Generator, announce: Announce
) -> list[Weighted]:
    """Points of sub-models from proposals that are fitted again until they are good."""
    best = list(found)
    pending = list(range(len(best)))
    proposals = [one.proposal for one in best]
    for round in range(N_REFITS + 1):
        announce("proposals", N_POINTS * len(pending))
        drawn = sampler.draw([proposals[i] for i in pending], [N_POINTS] * len(pending))
        for i, one in zip(pending, drawn, strict=True):
            if round == 0 or one.efficiency > best[i].efficiency:
                best[i] = one
        poor = [(i, one) for i, one in zip(pending, drawn, strict=True) if one.efficiency < GOOD]
        for i, one in poor:
            proposals[i] = one.refitted(rng)
        pending = [i for i, one in poor if proposals[i] is not one.proposal]
        if not pending:
            break
    return best


def probabilities(found: Sequence[Weighted], sets: Sets, log_prior: Array) -> Probabilities:
    """What the points say about the sub-models."""
    means = [one.mean for one in found]
    return Probabilities(
        sets, log_prior, np.array([one.value for one in means]), np.array([m.error for m in means])
    )


def _until_certain(
    found: Sequence[Weighted],
    sets: Sets,
    log_prior: Array,
    sampler: Sampler,
    rng: np.random.Generator,
    announce: Announce,
) -> list[Weighted]:
    """Add points until the inclusions have the error that is aimed at."""
    points, left = list(found), MOST_POINTS
    for _ in range(N_ROUNDS):
        known = probabilities(points, sets, log_prior)
        points = _with_lighter_tails(points, known, sampler, rng, announce)
        known = probabilities(points, sets, log_prior)
        more = np.minimum(_missing(known, [one.count for one in points]), left)
        chosen = np.flatnonzero(more * [len(one.x) for one in points])
        if known.inclusion_se.max() <= TARGET_SE or not chosen.size:
            break
        announce("more points", int(more[chosen].sum()))
        drawn = sampler.draw([points[i].proposal for i in chosen], more[chosen].tolist())
        left -= int(more[chosen].sum())
        for i, one in zip(chosen, drawn, strict=True):
            points[i] = points[i].joined(one)
    return points


def _with_lighter_tails(
    points: Sequence[Weighted],
    known: Probabilities,
    sampler: Sampler,
    rng: np.random.Generator,
    announce: Announce,
) -> list[Weighted]:
    """Fresh points of fitted proposals for sub-models that matter and are not reliable."""
    influence = known.influence()
    poor = [i for i, one in enumerate(points) if influence[i] > MATTERS and not one.is_reliable]
    counts = [max(points[i].count, 2 * N_POINTS) for i in poor]
    announce("better proposals", sum(counts))
    drawn = sampler.draw([points[i].refitted(rng) for i in poor], counts)
    better = list(points)
    for i, one in zip(poor, drawn, strict=True):
        if one.is_reliable or one.pareto_k < points[i].pareto_k:
            better[i] = one
    return better


def _missing(known: Probabilities, counts: Sequence[int]) -> np.ndarray:
    """How many points each sub-model lacks, (S,); at most as many as all have now."""
    n = np.array(counts)
    spread = np.where(np.isfinite(known.error), known.error, 0.0) * np.sqrt(n)
    share = known.influence() * spread
    needed = share * share.sum() / TARGET_SE**2
    missing = np.maximum(np.ceil(needed - n), 0)
    scale = min(1.0, n[share > 0].sum() / max(missing.sum(), 1.0))
    return np.asarray(np.ceil(scale * missing).astype(np.int64))
