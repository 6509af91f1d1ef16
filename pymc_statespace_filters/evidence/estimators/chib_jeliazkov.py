r"""Chib and Jeliazkov's estimate of the evidence, made after the draws (thesis, 3.3.2).

At any point x* of the unconstrained space, with f = log prior + log likelihood and a symmetric q,

.. math::

    \ln p(D) = f(x^*) - \ln \frac{E_{x \sim p(x|D)}[\alpha(x, x^*)\, q(x, x^*)]}
                                {E_{x \sim q(x^*, \cdot)}[\alpha(x^*, x)]},
    \qquad \alpha(x, y) = \min(1, e^{f(y) - f(x)})

(Eqs. 3.4, 3.38, 3.44). The draws need only come from the posterior, whatever kernel made them; q is
this file's own: N(x*, s^2 C), C the covariance of the draws. On a Gaussian posterior the relative
variances of the two means, per independent term, are [1 + 1/(s^2 (s^2 + 2))]^(k/2) - 1 and [1 +
s^4/(1 + 2 s^2)]^(k/2) - 1, mirror images about s = 1; autocorrelation enlarges the first and so
asks for a wider q, and s is chosen from the draws for the smallest sum.

Both variances grow exponentially with k, but slowly: from 40 000 draws of autocorrelation 0.8 and
20 000 proposals the error is 0.01 nats for k = 4, 0.03 for 12, 0.04 for 20 and 0.24 for 50. The
ordinate in blocks (`multi_block`) takes several times the evaluations, and its error is 0.06 for
k = 20 and 0.10 for 50; few draws favour it earlier. It is therefore used where one block with ten
parameters or more predicts an error that is too large, and nowhere else.

Differences from the source. The denominator's draws come from q(x*, .), where Eq. 3.40 reads as if
they came from the posterior. Proposals without density stay in its mean, as zeros. Constraints are
handled by transforms, with their Jacobian in f, instead of a folded q.

With a noisy likelihood f(x_s) is the estimate that the chain stored, f of a proposal is a fresh
one, and f(x*) is one constant in both means. Detailed balance of the chain on (x, noise) makes the
identity exact for the evidence of the expected likelihood, whatever the constant: it bears on the
error only.

Source: Chib and Jeliazkov, Marginal likelihood from the Metropolis-Hastings output, JASA 96 (2001).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.evidence.estimators.block_ordinates import (
    BlockEstimate,
    estimate_in_blocks,
)
from pymc_statespace_filters.evidence.estimators.protocol import Estimate
from pymc_statespace_filters.evidence.estimators.random_walk_proposal import (
    Proposal,
    ProposalPlan,
    plan_proposal,
)
from pymc_statespace_filters.evidence.log_mean import (
    MIN_EFFECTIVE,
    LogMean,
    log_mean_of_chains,
    log_mean_of_independent,
)
from pymc_statespace_filters.evidence.posterior.draws import Posterior

MIN_PROPOSALS = 100
MOST_PROPOSALS = 20_000
PROPOSALS_OF_RUN = 5000
MAX_GAP = 4.0
MIN_MOVES = 10  # of a walker, to forget where it started
MANY_PARAMETERS = 10
TOLERABLE = 0.1  # nats, a predicted error for which one block is left as it is
BLOCK_SIZE = 10


@dataclass(frozen=True)
class ChibJeliazkov:
    """Chib and Jeliazkov's estimator (Eq. 3.44).

    Each half of the chains fits the proposal under which the other half is averaged; the two
    estimates are averaged. Fitted to the very draws that it averages, q would overrate the
    ordinate, by as much as the standard error when the draws are few or sticky.

    Parameters
    ----------
    n_proposals : int, optional
        Evaluations in every mean that needs them, both halves together.
    n_blocks : int, optional
        Parts into which the parameters fall.
    """

    name: ClassVar[str] = "chib_jeliazkov"
    n_proposals: int | None = None
    n_blocks: int | None = None

    def __post_init__(self) -> None:
        for name, least in (("n_proposals", MIN_PROPOSALS), ("n_blocks", 1)):
            given = getattr(self, name)
            if given is not None and not (
                isinstance(given, int | np.integer)
                and not isinstance(given, bool)
                and given >= least
            ):
                raise ModelError(f"{name} must be an integer of at least {least}, got {given!r}")

    def n_evaluations(self, posterior: Posterior) -> int:
        """The largest number with one block, where fewer may do; about the number with several."""
        if self.n_blocks is None or self.n_blocks == 1:
            return self._most_proposals(posterior)
        return (3 * self.n_blocks - 2) * self._proposals_of_run(posterior)

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence from draws and a log-density that can be evaluated."""
        k = posterior.draws.shape[-1]
        if self.n_blocks is not None and self.n_blocks > k:
            raise ModelError(
                f"n_blocks must be at most the number of parameters, {k}, got {self.n_blocks}"
            )
        halves = posterior.halves()
        given = None if self.n_proposals is None else self.n_proposals // 2
        most = self._most_proposals(posterior) // 2
        plans = [plan_proposal(half, n_proposals=given, most=most, rng=rng) for half in halves]
        n_blocks = self.n_blocks or _choose_n_blocks(k, plans)
        pairs = list(zip(plans, reversed(halves), strict=True))
        if n_blocks == 1:
            single = [
                estimate_in_one_block(p.proposal, half, p.n_proposals, rng=rng) for p, half in pairs
            ]
            found = _of_one_block(single, sum(plan.n_proposals for plan in plans))
        else:
            n_proposals = self._proposals_of_run(posterior)
            several = [
                estimate_in_blocks(
                    p.proposal, half, n_blocks=n_blocks, n_proposals=n_proposals // 2, rng=rng
                )
                for p, half in pairs
            ]
            found = _of_blocks(several, n_blocks, n_proposals)
        return replace(found, settings={"n_draws": posterior.log_density.size, **found.settings})

    def _most_proposals(self, posterior: Posterior) -> int:
        return self.n_proposals or min(max(posterior.log_density.size, 1000), MOST_PROPOSALS)

    def _proposals_of_run(self, posterior: Posterior) -> int:
        return self.n_proposals or min(max(posterior.log_density.size, 1000), PROPOSALS_OF_RUN)


@dataclass(frozen=True)
class OneBlockEstimate:
    """A log-evidence and the two means behind it."""

    log_evidence: float
    scale: float
    numerator: LogMean
    denominator: LogMean
    zero_density: float  # share of the proposals

    @property
    def se(self) -> float:
        """Standard error, from the draws and from the proposals."""
        return math.hypot(self.numerator.error, self.denominator.error)


def estimate_in_one_block(
    proposal: Proposal, posterior: Posterior, n_proposals: int, *, rng: np.random.Generator
) -> OneBlockEstimate:
    """Estimate the log-evidence with a proposal that was fitted to other draws."""
    # Numerator: the draws, with the log-densities that their chain stored.
    numerator = log_mean_of_chains(
        proposal.log_alpha_to_center(posterior.log_density) + proposal.log_q(posterior.draws)
    )

    # Denominator: draws from q(x*, .), with fresh log-densities.
    log_alpha = proposal.log_alpha_from_center(
        posterior.evaluate(proposal.sample(n_proposals, rng), rng)
    )
    denominator = log_mean_of_independent(log_alpha)
    if np.isneginf(denominator.value):
        raise DataMismatchError(
            f"none of {n_proposals} proposals around the draws has a density: idata belongs to "
            "another model or to other data"
        )
    log_evidence = proposal.log_density - numerator.value + denominator.value
    impossible = float(np.isneginf(log_alpha).mean())
    return OneBlockEstimate(log_evidence, proposal.scale, numerator, denominator, impossible)


def _choose_n_blocks(k: int, plans: Sequence[ProposalPlan]) -> int:
    """One block, unless there are many parameters and it promises too large an error."""
    predicted = math.hypot(*(plan.se for plan in plans)) / 2
    if k < MANY_PARAMETERS or predicted <= TOLERABLE:
        return 1
    return max(2, -(-k // BLOCK_SIZE))


def _of_one_block(folds: Sequence[OneBlockEstimate], n_proposals: int) -> Estimate:
    numerator = _effective(fold.numerator.n_effective for fold in folds)
    denominator = _effective(fold.denominator.n_effective for fold in folds)
    doubts = []
    if numerator < MIN_EFFECTIVE:
        doubts.append(
            f"the draws near its central point are worth {numerator:.0f} independent "
            f"ones, fewer than {MIN_EFFECTIVE}: draw more"
        )
    if denominator < MIN_EFFECTIVE:
        doubts.append(
            f"the proposals are worth {denominator:.0f} independent ones, fewer than "
            f"{MIN_EFFECTIVE}: raise n_proposals, or give the parameters a scale on which their "
            "posterior is nearer to a Gaussian"
        )
    settings = {
        "n_blocks": 1,
        "scale": math.sqrt(folds[0].scale * folds[1].scale),
        "n_proposals": n_proposals,
        "n_effective_numerator": numerator,
        "n_effective_denominator": denominator,
        "zero_density": float(np.mean([fold.zero_density for fold in folds])),
    }
    return _averaged(folds, settings, doubts)


def _of_blocks(folds: Sequence[BlockEstimate], n_blocks: int, n_proposals: int) -> Estimate:
    effective = _effective(fold.n_effective for fold in folds)
    n_moves = min(fold.n_moves for fold in folds)
    doubts = []
    if effective < MIN_EFFECTIVE:
        doubts.append(
            f"one of its runs is worth {effective:.0f} independent draws, fewer than "
            f"{MIN_EFFECTIVE}: raise n_proposals and draw more, or give the parameters a scale on "
            "which their posterior is nearer to a Gaussian"
        )
    if n_moves < MIN_MOVES:
        doubts.append(
            f"the walkers of a reduced run moved {n_moves:.1f} times, fewer than {MIN_MOVES}: "
            "raise n_proposals, or give the parameters a scale on which their posterior is nearer "
            "to a Gaussian"
        )
    settings = {
        "n_blocks": n_blocks,
        "n_proposals": n_proposals,
        "n_effective": effective,
        "n_moves": n_moves,
    }
    return _averaged(folds, settings, doubts)


def _averaged(
    folds: Sequence[OneBlockEstimate] | Sequence[BlockEstimate],
    settings: dict[str, float],
    doubts: list[str],
) -> Estimate:
    """The mean of two independent estimates of the log-evidence."""
    error = math.hypot(*(fold.se for fold in folds))  # of their difference and of their sum
    gap = abs(folds[0].log_evidence - folds[1].log_evidence) / error
    if gap > MAX_GAP:
        doubts = [*doubts, f"the halves of the draws differ by {gap:.1f} of their standard errors"]
    log_evidence = float(np.mean([fold.log_evidence for fold in folds]))
    return Estimate(log_evidence, error / 2, settings, tuple(doubts))


def _effective(halves: Iterable[float]) -> float:
    """Effective number of the average of two independent means."""
    return 4 / sum(1 / number for number in halves)
