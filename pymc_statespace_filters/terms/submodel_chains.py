r"""A chain over sub-models, where they are too many to be estimated one by one.

A step adds or drops a term, or swaps one for another; both kinds of moves are symmetric. The
evidence of a proposed sub-model is estimated anew, by the mean of raw weights, and that of the
current one is kept: with unbiased estimates the chain has exactly the posterior over sub-models as
its law (Andrieu and Roberts 2009), however large the errors are, which only decide how well it
moves. The number of points of an estimate is that of a relative variance of a half or less.

A start may be far from all that is probable: a chain that is out of reach of the best sub-model met
when the first steps are over begins again there.

The proposal density of a sub-model is fitted when it is first met, from points of its own, and
stays. All weights together then give the evidences of all sub-models that were met, and
probabilities renormalised over these, which have smaller errors than frequencies of visits but know
nothing of what was not met. What one chain visits and no other has met shows how much that is.

Where draws of the full model are no guide, the chains start with no terms, and the proposal density
of a sub-model comes from its own maxima, which those of the sub-model that a chain comes from lead
to (`maxima`).
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..statistics.importance import mcse_of_chains
from .inclusion import InclusionPrior
from .maxima import Maxima, Maximum, proposal_by
from .proposals import Guide
from .screening import GOOD, REACH, Announce, improved, screened
from .submodel_density import Array, Sets
from .submodel_evidence import Sampler, Visits, Weighted

N_CHAINS, N_STEPS, N_DROPPED = 4, 1000, 200  # the first steps are dropped
STARTS = (1.0, 2.0, 3.0)  # standard deviations from where a term vanishes, to be present at first
FEWEST, MOST = 32, 400  # points of an estimate
VARIANCE = 0.5  # relative, of an estimate
SUFFICIENT = 1 / (1 + VARIANCE * FEWEST)  # effective points per point, that need no more of them
MARGIN = 3.0  # nats, of a log-evidence by a maximum
MOST_MENDED = 60  # sub-models that get better proposals at the end, where draws are no guide


class _Met:
    """Sub-models that were met: their proposal densities, and all points drawn since."""

    def __init__(
        self,
        prior: InclusionPrior,
        guide: Guide,
        sampler: Sampler,
        rng: np.random.Generator,
        maxima: Maxima | None,
    ) -> None:
        self._prior, self._guide, self._maxima = prior, guide, maxima
        self._sampler, self._rng = sampler, rng
        self._found: dict[bytes, list[Maximum]] = {}
        self._highest = -np.inf
        self._pilots: dict[bytes, Weighted] = {}
        self.points: dict[bytes, Weighted] = {}

    def heights(self, sets: Sets, before: Sets) -> Array:
        """New estimates of the log-posterior of sub-models (m, K), each from points of its own.

        ``before`` has the sub-models (m, K) from which they were reached.
        """
        by_key = {one.tobytes(): (one, b.tobytes()) for one, b in zip(sets, before, strict=True)}
        self._fit({key: one for key, one in by_key.items() if key not in self._pilots})
        keys = [one.tobytes() for one in sets]
        pilots = [self._pilots[key] for key in keys]
        drawn = self._sampler.draw([one.proposal for one in pilots], [_count(p) for p in pilots])
        for key, one in zip(keys, drawn, strict=True):
            known = self.points.get(key)
            self.points[key] = one if known is None else known.joined(one)
        return self._heights(drawn, sets)

    def lost(self, sets: Sets) -> NDArray[np.bool_]:
        """Whether sub-models (m, K) are out of reach of the best, by all points of each."""
        points = [self.points[one.tobytes()] for one in sets]
        return self._heights(points, sets) < self._heights_of_all().max() - REACH

    @property
    def best(self) -> Sets:
        """The most probable sub-model that was met, (K,)."""
        number = int(np.argmax(self._heights_of_all()))
        return list(self.points.values())[number].proposal.present

    def _heights_of_all(self) -> Array:
        points = list(self.points.values())
        return self._heights(points, np.array([one.proposal.present for one in points]))

    def _fit(self, new: dict[bytes, tuple[Sets, bytes]]) -> None:
        """Fit the proposal densities of sub-models, again and again if they are within reach."""
        if not new:
            return
        sets = np.array([one for one, _ in new.values()])
        first = [self._guide.proposal(one) for one in sets]
        log_prior = self._prior.log_weight(sets)
        if self._maxima is not None:
            least = self._highest - log_prior - REACH - MARGIN
            for i, (key, (_, before)) in enumerate(new.items()):
                known = self._found.get(before, [])
                self._found[key] = self._maxima.of(first[i], known, least[i])
                first[i] = proposal_by(self._found[key], first[i])
        found, chosen = screened(first, log_prior, self._sampler, self._rng, self._highest)
        self._highest = max(self._highest, self._heights(found, sets).max())
        within = np.flatnonzero(chosen).tolist()
        better = improved(
            [found[i].proposal for i in within],
            self._sampler,
            self._rng,
            lambda task, total: None,
            good=GOOD if self._maxima is None else SUFFICIENT,
        )
        for i, one in zip(within, better, strict=True):
            found[i] = one
        self._pilots |= dict(zip(new, found, strict=True))

    def _heights(self, found: Sequence[Weighted], sets: Sets) -> Array:
        return np.asarray(self._prior.log_weight(sets) + [one.mean.value for one in found])


def _count(pilot: Weighted) -> int:
    """How many points give an estimate the variance that is aimed at."""
    efficiency = max(pilot.efficiency, 1e-6)
    return int(np.clip((1 / efficiency - 1) / VARIANCE, FEWEST, MOST))


def run_chains(
    prior: InclusionPrior,
    guide: Guide,
    sampler: Sampler,
    rng: np.random.Generator,
    announce: Announce,
    maxima: Maxima | None = None,
) -> Visits:
    """Let several chains walk over the sub-models, in step with each other.

    With ``maxima`` the proposal densities do without the guide.
    """
    met = _Met(prior, guide, sampler, rng, maxima)
    at, seen = _starts(prior, guide, maxima is None), _Seen()
    seen.note(range(N_CHAINS), at)
    height = met.heights(at, at)
    visited = np.empty((N_CHAINS, N_STEPS, at.shape[1]), dtype=bool)
    announce("chains over sub-models", N_CHAINS * N_STEPS * FEWEST)
    for step in range(N_STEPS):
        proposed = np.array([_moved(one, prior.is_open, rng) for one in at])
        tried = np.flatnonzero((proposed != at).any(axis=1) & prior.permits(proposed))
        new = met.heights(proposed[tried], at[tried]) if tried.size else np.empty(0)
        seen.note(tried, proposed[tried])
        accepted = np.log(rng.random(len(tried))) < new - height[tried]
        at[tried[accepted]] = proposed[tried[accepted]]
        height[tried[accepted]] = new[accepted]
        visited[:, step] = at
        if step == N_DROPPED - 1:
            lost = np.flatnonzero(met.lost(at))
            at[lost] = met.best
            seen.note(lost, at[lost])
            height[lost] = met.heights(at[lost], at[lost]) if lost.size else height[lost]
    kept = visited[:, N_DROPPED:].astype(float)
    error = [mcse_of_chains(one) if np.ptp(one) else 0.0 for one in np.moveaxis(kept, -1, 0)]
    alone = seen.alone(visited[:, N_DROPPED:])
    points = list(met.points.values())
    return Visits(
        sets=np.array([one.proposal.present for one in points]),
        points=points,
        frequency=kept.mean(axis=(0, 1)),
        error=np.array(error),
        alone=alone.mean(axis=1),
        frequency_alone=(alone[..., None] * kept).mean(axis=1),
    )


class _Seen:
    """Which chains have met a sub-model."""

    def __init__(self) -> None:
        self._chains: defaultdict[bytes, set[int]] = defaultdict(set)

    def note(self, chains: Iterable[int], sets: Sets) -> None:
        """Each of these chains has met one of the sub-models (m, K)."""
        for chain, one in zip(chains, sets, strict=True):
            self._chains[one.tobytes()].add(int(chain))

    def alone(self, visited: Sets) -> NDArray[np.bool_]:
        """Whether no other chain has met what a chain has visited, of visits (chain, step, K)."""
        return np.array([[len(self._chains[one.tobytes()]) == 1 for one in of] for of in visited])


def _moved(present: Sets, is_open: Sets, rng: np.random.Generator) -> Sets:
    """A set with one term added or dropped, or one swapped for another."""
    moved = present.copy()
    inside, outside = np.flatnonzero(present & is_open), np.flatnonzero(~present & is_open)
    if rng.random() < 0.5:
        moved[rng.choice(np.flatnonzero(is_open))] ^= True
    elif inside.size and outside.size:
        moved[rng.choice(inside)] = False
        moved[rng.choice(outside)] = True
    return moved


def _starts(prior: InclusionPrior, guide: Guide, is_guided: bool) -> Sets:
    """The full model, and those of the terms that the draws say are far from vanishing.

    No terms, if draws are no guide.
    """
    distance = guide.distances
    starts = [np.zeros(len(distance), dtype=bool)] * N_CHAINS
    if is_guided:
        starts = [np.ones(len(distance), dtype=bool), *(distance > limit for limit in STARTS)]
    is_certain = ~prior.is_open
    if prior.probability is not None:
        certain = prior.probability == 1
        starts = [np.where(is_certain, certain, one) for one in starts]
    return np.array([_with_needed(one, prior) for one in starts])


def _with_needed(present: Sets, prior: InclusionPrior) -> Sets:
    """A set with all that its members require."""
    while not prior.permits(present):
        present = present | prior.needed[present].any(axis=0)
    return present
