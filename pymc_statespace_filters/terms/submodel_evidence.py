r"""The evidence of sub-models by importance sampling, each from points of its own.

.. math::

    Z_M = E_{x \sim q_M}[w], \qquad w = f_M(x) / q_M(x) .

The mean of the raw weights is unbiased whatever the proposal :math:`q_M` is, and with unbiased
estimates of the likelihood, each with fresh noise. Points of different sub-models are independent,
so that the errors of evidences are. Points that a proposal is fitted to serve for nothing else.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from ..evidence.estimators.newton import BatchFunction
from ..statistics.importance import (
    MIN_EFFECTIVE,
    LogMean,
    largest_good_k,
    log_mean_of_independent,
    pareto_k,
)
from .proposals import Proposal
from .submodel_density import Array, Point, Seeds, Sets, SubmodelDensity

LEAST_EFFECTIVE = MIN_EFFECTIVE / 2  # points of a sub-model whose error can be believed
LEAST_FOR_TAIL = 25  # weights to which a Pareto tail is fitted


@dataclass(frozen=True)
class Weighted:
    """Points of a sub-model with their weights, and the law that they come from."""

    proposal: Proposal
    x: Array  # (n, k)
    seeds: Seeds  # (n, v)
    log_weights: Array  # (n,)

    @property
    def count(self) -> int:
        """The number of points."""
        return len(self.log_weights)

    @cached_property
    def mean(self) -> LogMean:
        """The evidence."""
        return log_mean_of_independent(self.log_weights)

    @property
    def n_effective(self) -> float:
        """The effective number of points."""
        return self.mean.kish_ess(self.count)

    @property
    def efficiency(self) -> float:
        """Effective points per point, of 0 to 1."""
        return self.n_effective / self.count

    @cached_property
    def pareto_k(self) -> float:
        """The shape of the upper tail of the weights."""
        if self.count < LEAST_FOR_TAIL or np.isneginf(self.log_weights).all():
            return np.inf
        return pareto_k(self.log_weights)

    @property
    def is_reliable(self) -> bool:
        """Whether the error of the mean can be believed."""
        is_light = self.pareto_k <= largest_good_k(self.count)
        return is_light and self.n_effective >= LEAST_EFFECTIVE

    def joined(self, more: "Weighted") -> "Weighted":
        """With more points of the same proposal."""
        return Weighted(
            self.proposal,
            np.concatenate([self.x, more.x]),
            np.concatenate([self.seeds, more.seeds]),
            np.concatenate([self.log_weights, more.log_weights]),
        )

    def without_points(self) -> "Weighted":
        """The weights alone, which need less memory."""
        return replace(self, x=self.x[:0], seeds=self.seeds[:0])

    def refitted(self, rng: np.random.Generator, others: Sequence["Weighted"] = ()) -> Proposal:
        """The proposal fitted to the weighted points, and to those of other proposals.

        All points are weighted as if drawn from the mixture of their proposals, so that no lucky
        point of a poor one has all the weight (Cornuet, Marin, Mira and Robert 2012).
        """
        every = [self, *others]
        counts = [one.count for one in every]
        x = np.concatenate([one.x for one in every])
        log_q = np.array([one.proposal.log_density_of_drawn(x) for one in every])
        own = log_q[np.repeat(np.arange(len(every)), counts), np.arange(len(x))]
        mixed = logsumexp(log_q, axis=0, b=np.array(counts)[:, None] / len(x))
        log_weights = np.concatenate([one.log_weights for one in every]) + own - mixed
        return self.proposal.refitted(x, log_weights, rng)


@dataclass(frozen=True)
class Visits:
    """What chains over sub-models have visited.

    ``alone`` (C,) is the share of the visits of each chain to sub-models that no other chain has
    met, and ``frequency_alone`` (C, K) how often a visit was such a one, with the term present.
    """

    sets: Sets  # (S, K), the sub-models that were met
    points: list[Weighted]  # all points of each
    frequency: Array  # (K,), how often each term was present
    error: Array  # (K,), of the frequency
    alone: Array
    frequency_alone: Array

    def missed(self, inclusion: Array) -> Array:
        """How far sub-models that were not met may move inclusions (K,).

        What the other chains have missed of the visits of one is about as much as all have missed
        of the posterior, or more. Frequencies of visits miss nothing, and bound it.
        """
        moved = self.frequency_alone - self.alone[:, None] * inclusion
        bound = np.hypot(self.frequency - inclusion, self.error)
        return np.asarray(np.minimum(np.sqrt((moved**2).mean(axis=0)), bound))


class Sampler:
    """Draws points of sub-models and weights them.

    ``base`` (k,) has values for columns that a sub-model does not have.
    """

    def __init__(self, density: SubmodelDensity, base: Array, rng: np.random.Generator) -> None:
        self._density, self._base, self._rng = density, base, rng

    @property
    def is_noisy(self) -> bool:
        """Whether likelihoods are estimates."""
        return bool(self._density.density.seed_names)

    def log_density_of(self, proposal: Proposal) -> BatchFunction:
        """The log-density (n,) of a sub-model at coordinates (n, d) that its proposal draws.

        Of a likelihood without noise.
        """

        def evaluate(drawn: Array) -> Array:
            y = np.tile(self._base, (len(drawn), 1))
            y[:, proposal.drawn] = drawn
            x, log_volume = proposal.coordinates.backward(y, proposal.drawn)
            present = np.broadcast_to(proposal.present, (len(x), len(proposal.present)))
            seeds = np.zeros((len(x), 0), dtype=np.int64)
            return self._density.evaluate(Point(x, present, seeds)).total - log_volume

        return evaluate

    def draw(self, proposals: Sequence[Proposal], counts: Sequence[int]) -> list[Weighted]:
        """So many points of each proposal."""
        if not proposals:
            return []
        drawn = [
            one.sample(count, self._base, self._rng)
            for one, count in zip(proposals, counts, strict=True)
        ]
        x = np.concatenate([points for points, _ in drawn])
        present = np.repeat([one.present for one in proposals], counts, axis=0)
        seeds = self._density.density.fresh_seeds(len(x), self._rng)
        log_q = np.concatenate([log_q for _, log_q in drawn])
        log_weights = self._density.evaluate(Point(x, present, seeds)).total - log_q
        ends = np.cumsum(counts)[:-1]
        parts = (np.split(each, ends) for each in (x, seeds, log_weights))
        return [
            Weighted(proposal, *each) for proposal, *each in zip(proposals, *parts, strict=True)
        ]
