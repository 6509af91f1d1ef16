"""All sub-models: evaluations go to those that matter, by successive halving.

A few points of each say which sub-models are out of reach (`screening`). The proposals of the
others are fitted again until their weights are good. Then points are added where they reduce the
error of an inclusion most (Neyman 1934).
"""

from collections.abc import Sequence

import numpy as np

from .candidates import Candidates
from .doubts import NEGLIGIBLE, check_finite
from .inclusion import InclusionPrior
from .probabilities import Probabilities
from .proposals import Guide
from .screening import N_SCREENED, Announce, improved, screened
from .submodel_density import Array, Sets
from .submodel_evidence import LEAST_EFFECTIVE, Sampler, Weighted

FEWEST = 100  # points of a sub-model within reach
LARGE, ENOUGH = (
    0.01,
    1000,
)  # an influence on inclusions, and the points of such a sub-model at least
HIDDEN = 0.1  # part of it that counts where a heavy tail may hide most of an evidence
MOST_POOR = 8  # sub-models that get better proposals, for some thousand points each
TARGET_SE, NOISY_SE = 0.005, 0.01  # of an inclusion; with likelihoods that are estimates
N_ROUNDS, MOST_POINTS = 6, 50_000  # of points that are added to reach it


def estimate_all(
    sets: Sets,
    candidates: Candidates,
    prior: InclusionPrior,
    guide: Guide,
    sampler: Sampler,
    rng: np.random.Generator,
    announce: Announce,
) -> list[Weighted]:
    """Points of all sub-models (S, K), enough for the probabilities of inclusion."""
    log_prior = prior.log_weight(sets)
    announce("all sub-models", N_SCREENED * len(sets))
    proposals = [guide.proposal(one) for one in sets]
    found, chosen = screened(proposals, log_prior, sampler, rng)
    check_finite(found, candidates)
    found = [one if chosen[i] else one.without_points() for i, one in enumerate(found)]
    within = np.flatnonzero(chosen)
    pilots = improved([found[i].proposal for i in within], sampler, rng, announce)
    # Weights by which a proposal was chosen are no part of an estimate: good luck is chosen too.
    judged = list(found)
    for i, one in zip(within, pilots, strict=True):
        judged[i] = one
    known = probabilities(judged, sets, log_prior)
    # A term that is certain moves with no evidence, but the error of this is told as well.
    matter = known.of_models > NEGLIGIBLE
    least = np.where(matter, [_enough_for_error(one) for one in judged], FEWEST)
    counts = np.maximum(_least(known), least)[within]
    announce("sub-models within reach", int(counts.sum()))
    drawn = sampler.draw([one.proposal for one in pilots], counts.tolist())
    for i, one in zip(within, drawn, strict=True):
        found[i] = one
    found = with_lighter_tails(found, sets, log_prior, sampler, rng, announce)
    return until_certain(found, sets, log_prior, sampler, announce)


def probabilities(found: Sequence[Weighted], sets: Sets, log_prior: Array) -> Probabilities:
    """What the points say about the sub-models."""
    means = [one.mean for one in found]
    return Probabilities(
        sets, log_prior, np.array([one.value for one in means]), np.array([m.error for m in means])
    )


def until_certain(
    found: Sequence[Weighted], sets: Sets, log_prior: Array, sampler: Sampler, announce: Announce
) -> list[Weighted]:
    """Add points until the inclusions have the error that is aimed at."""
    points, left = list(found), MOST_POINTS
    target = NOISY_SE if sampler.is_noisy else TARGET_SE
    for _ in range(N_ROUNDS):
        known = probabilities(points, sets, log_prior)
        more = _missing(known, [one.count for one in points], target, left)
        chosen = np.flatnonzero(more * [len(one.x) for one in points])
        if not chosen.size:
            break
        announce("more points", int(more[chosen].sum()))
        drawn = sampler.draw([points[i].proposal for i in chosen], more[chosen].tolist())
        left -= int(more[chosen].sum())
        for i, one in zip(chosen, drawn, strict=True):
            points[i] = points[i].joined(one)
    return points


def with_lighter_tails(
    found: Sequence[Weighted],
    sets: Sets,
    log_prior: Array,
    sampler: Sampler,
    rng: np.random.Generator,
    announce: Announce,
    most: int = MOST_POOR,
) -> list[Weighted]:
    """Fresh points of better proposals, where weights that matter have a heavy tail.

    Of so many sub-models at ``most``.
    """
    influence = probabilities(found, sets, log_prior).influence()
    matter = np.argsort(-influence)[: (influence > HIDDEN * LARGE).sum()].tolist()
    poor = [i for i in matter if not found[i].is_reliable][:most]
    trials = improved([found[i].proposal for i in poor], sampler, rng, announce, ENOUGH)
    better = list(found)
    good = [
        (i, one) for i, one in zip(poor, trials, strict=True)
        if one.is_reliable or one.pareto_k < found[i].pareto_k
    ]  # fmt: skip
    counts = [max(found[i].count, ENOUGH) for i, _ in good]
    announce("better proposals", sum(counts))
    fresh = sampler.draw([one.proposal for _, one in good], counts)
    for (i, _), one in zip(good, fresh, strict=True):
        better[i] = one
    return better


def _enough_for_error(pilot: Weighted) -> int:
    """Points whose error can be believed, with some to spare, by what those of a pilot are worth.

    At most as many as a sub-model with a large influence has.
    """
    effective = 2 * LEAST_EFFECTIVE
    if not pilot.efficiency * ENOUGH > effective:
        return ENOUGH
    return max(FEWEST, int(np.ceil(effective / pilot.efficiency)))


def _least(known: Probabilities) -> np.ndarray:
    """How many points sub-models need in any case, (S,), by what they matter.

    A spread found from few points may be too small.
    """
    return np.ceil(ENOUGH * np.minimum(known.influence() / LARGE, 1.0)).astype(np.int64)


def _missing(known: Probabilities, counts: Sequence[int], target: float, left: int) -> np.ndarray:
    """How many points each sub-model lacks, (S,); together at most ``left``.

    They are also at most as many as all have now: new points show what is missing more exactly.
    """
    n = np.array(counts)
    spread = np.where(np.isfinite(known.error), known.error, 0.0) * np.sqrt(n)
    share = known.influence() * spread
    needed = np.maximum(share * share.sum() / target**2, _least(known))
    missing = np.maximum(np.ceil(needed - n), 0)
    most = min(n[share > 0].sum(), left)
    scale = min(1.0, most / max(missing.sum(), 1.0))
    return np.floor(scale * missing).astype(np.int64)
