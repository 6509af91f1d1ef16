r"""Chib and Jeliazkov's estimate of the evidence, made after the draws (thesis, 3.3.2).

At any point x* of the unconstrained space, with f = log prior + log likelihood and a symmetric q,

.. math::

    \ln p(D) = f(x^*) - \ln \frac{E_{x \sim p(x|D)}[\alpha(x, x^*)\, q(x, x^*)]}
                                {E_{x \sim q(x^*, \cdot)}[\alpha(x^*, x)]},
    \qquad \alpha(x, y) = \min(1, e^{f(y) - f(x)})

(Eqs. 3.4, 3.38, 3.44). The draws may come from any sampler; q does not depend on it: q(x*, .) is
N(x*, s^2 C) with the covariance C of the draws. On a Gaussian posterior the relative variances of
the two means, per independent term, are [1 + 1/(s^2 (s^2 + 2))]^(k/2) - 1 and [1 + s^4/(1 + 2
s^2)]^(k/2) - 1, symmetric about s = 1 on a log scale. Autocorrelation of the draws increases the
first and favours a wider q; s is chosen from the draws to minimise the sum.

Both variances grow exponentially with k, but slowly: from 40 000 draws of autocorrelation 0.8 and
20 000 proposals the error is 0.01 nats for k = 4, 0.03 for 12, 0.04 for 20 and 0.24 for 50. The
ordinate in blocks (`block_ordinates`) takes several times as many evaluations, and its error is
0.06 for k = 20 and 0.10 for 50; with few draws it pays earlier. It is used only for ten parameters
or more, if the error predicted for one block is too large.

Differences from the source. The denominator's draws come from q(x*, .), whereas Eq. 3.40 reads as
if they came from the posterior. Proposals of zero density stay in its mean, as zeros. Constraints
are handled by transforms, with their Jacobian in f, instead of a folded q.

With a noisy likelihood, f(x_s) is the estimate stored by the chain, f of a proposal is a fresh
estimate, and f(x*) is one constant in both means. Detailed balance of the chain on (x, noise) makes
the identity exact for the evidence of the expected likelihood, for any constant; the constant
affects only the error.

Source: Chib and Jeliazkov, Marginal likelihood from the Metropolis-Hastings output, JASA 96 (2001).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ...errors import ModelError
from ...statistics.importance import (
    MIN_EFFECTIVE,
    LogMean,
    disagreement,
    log_mean_of_draws,
    log_mean_of_independent,
)
from ...system.checks import check_count
from ..posterior import Posterior, check_overlap
from .block_ordinates import BlockEstimate, estimate_in_blocks
from .protocol import Estimate
from .random_walk_proposal import Proposal, ProposalPlan, plan_proposal
from .stopping import FEWEST, check_target, is_small, ratio_of_errors, shortfall
from .whitening import normal_proposals

MIN_PROPOSALS = 100
MOST_PROPOSALS = 20_000
PROPOSALS_OF_RUN = 5000
MAX_GAP = 4.0
MIN_MOVES = 10  # accepted by a walker, to be independent of its starting point
MANY_PARAMETERS = 10
TOLERABLE = 0.1  # nats, predicted error up to which one block is used
BLOCK_SIZE = 10
REMEDY = "draw more, set n_proposals, or reparametrise towards a Gaussian posterior"


@dataclass(frozen=True)
class ChibJeliazkov:
    """Chib and Jeliazkov's estimator (Eq. 3.44).

    Cross-fitted: the proposal fitted to one half of every chain is used with the draws of the other
    half, and the two estimates are averaged. A proposal fitted to the draws that it averages
    overestimates the ordinate, by as much as the standard error if the draws are few or strongly
    autocorrelated.

    Parameters
    ----------
    n_proposals : int, optional
        Evaluations per mean, both halves together.
    n_blocks : int, optional
        Number of parameter blocks.
    target_se : float, optional
        Standard error to be reached, with one block and without `n_proposals`. The number of
        proposals is the one predicted to do so, doubled while it does not, from 1000 to the number
        of draws, at most 20 000: with fewer draws than proposals, more draws help more.
    """

    name: ClassVar[str] = "chib_jeliazkov"
    n_proposals: int | None = None
    n_blocks: int | None = None
    target_se: float | None = None

    def __post_init__(self) -> None:
        check_target(self.target_se)
        for name, least in (("n_proposals", MIN_PROPOSALS), ("n_blocks", 1)):
            given = getattr(self, name)
            if given is not None:
                check_count(name, given, least)

    def n_evaluations(self, posterior: Posterior) -> int:
        """An upper bound with one block, or the fewest with a target; roughly with several."""
        if self.n_blocks is None or self.n_blocks == 1:
            return FEWEST if self._target_of_half else self._most_proposals(posterior)
        return (3 * self.n_blocks - 2) * self._proposals_of_run(posterior)

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence from the draws and further log-density evaluations."""
        k = posterior.draws.shape[-1]
        if self.n_blocks is not None and self.n_blocks > k:
            raise ModelError(
                f"n_blocks must be at most the number of parameters, {k}, got {self.n_blocks}"
            )
        plans = self._plans(posterior, rng)
        n_blocks = self.n_blocks or _choose_n_blocks(k, plans)
        pairs = list(zip(plans, reversed(posterior.halves()), strict=True))
        if n_blocks == 1:
            single = [
                estimate_in_one_block(
                    p.proposal,
                    half,
                    p.n_proposals,
                    most=self._most_proposals(posterior) // 2,
                    target_se=self._target_of_half,
                    rng=rng,
                )
                for p, half in pairs
            ]
            found = _of_one_block(single)
            se_draws = found.settings["n_effective_numerator"] ** -0.5
            se_proposals = found.settings["n_effective_denominator"] ** -0.5
        else:
            n_proposals = self._proposals_of_run(posterior)
            several = [
                estimate_in_blocks(
                    p.proposal, half, n_blocks=n_blocks, n_proposals=n_proposals // 2, rng=rng
                )
                for p, half in pairs
            ]
            found = _of_blocks(several, n_blocks, n_proposals)
            se_draws, se_proposals = 0.0, found.se
        n_draws = posterior.log_density.size
        return replace(
            found,
            settings={"n_draws": n_draws, **found.settings},
            shortfall=shortfall(self.target_se, se_draws, se_proposals, n_draws, REMEDY),
        )

    def _plans(self, posterior: Posterior, rng: np.random.Generator) -> list[ProposalPlan]:
        """The plans of both halves."""
        given = None if self.n_proposals is None else self.n_proposals // 2
        most = self._most_proposals(posterior) // 2
        pilots = normal_proposals(posterior, rng)
        return [
            plan_proposal(
                half, pilot, n_proposals=given, most=most, target_se=self._target_of_half, rng=rng
            )
            for half, pilot in zip(posterior.halves(), pilots, strict=True)
        ]

    @property
    def _target_of_half(self) -> float | None:
        """The error of each half that gives the average its target."""
        if self.target_se is None or self.n_proposals is not None:
            return None
        return math.sqrt(2) * self.target_se

    def _most_proposals(self, posterior: Posterior) -> int:
        return self.n_proposals or min(max(posterior.log_density.size, 1000), MOST_PROPOSALS)

    def _proposals_of_run(self, posterior: Posterior) -> int:
        return self.n_proposals or min(max(posterior.log_density.size, 1000), PROPOSALS_OF_RUN)


@dataclass(frozen=True)
class OneBlockEstimate:
    """A log-evidence and its two means."""

    log_evidence: float
    scale: float
    numerator: LogMean
    denominator: LogMean
    n_proposals: int
    zero_density: float  # fraction of the proposals
    disagreement: str = ""  # of the chains, about the terms of the numerator

    @property
    def se(self) -> float:
        """Standard error, from the draws and from the proposals."""
        return math.hypot(self.numerator.error, self.denominator.error)


def estimate_in_one_block(
    proposal: Proposal,
    posterior: Posterior,
    n_proposals: int,
    *,
    most: int = MOST_PROPOSALS,
    target_se: float | None = None,
    rng: np.random.Generator,
) -> OneBlockEstimate:
    """Estimate the log-evidence with a proposal fitted to other draws.

    With ``target_se`` the number of proposals is doubled while more of them help to reach it, up to
    ``most``.
    """
    # Numerator: the draws, with the log-densities stored by the chain.
    log_terms = proposal.log_alpha_to_center(posterior.log_density)
    log_terms = log_terms + proposal.log_q(posterior.draws)
    numerator = log_mean_of_draws(log_terms)

    # Denominator: draws from q(x*, .), with fresh log-densities.
    ratio = 0.0 if target_se is None else ratio_of_errors(target_se, numerator.error)
    log_density = np.empty(0)
    while True:
        proposals = proposal.sample(n_proposals - len(log_density), rng)
        log_density = np.append(log_density, posterior.evaluate(proposals, rng))
        check_overlap(log_density)
        denominator = log_mean_of_independent(proposal.log_alpha_from_center(log_density))
        small = is_small(target_se, numerator.error, denominator.error, ratio)
        if small or n_proposals >= most:
            break
        n_proposals = min(2 * n_proposals, most)
    log_evidence = proposal.log_density - numerator.value + denominator.value
    zero_density = float(np.isneginf(log_density).mean())
    return OneBlockEstimate(
        log_evidence,
        proposal.scale,
        numerator,
        denominator,
        n_proposals,
        zero_density,
        disagreement(log_terms),
    )


def _choose_n_blocks(k: int, plans: Sequence[ProposalPlan]) -> int:
    """One block, unless there are many parameters and its predicted error is too large."""
    predicted = math.hypot(*(plan.se for plan in plans)) / 2
    if k < MANY_PARAMETERS or predicted <= TOLERABLE:
        return 1
    return max(2, -(-k // BLOCK_SIZE))


def _of_one_block(folds: Sequence[OneBlockEstimate]) -> Estimate:
    numerator = _effective(fold.numerator.n_effective for fold in folds)
    denominator = _effective(fold.denominator.n_effective for fold in folds)
    doubts = []
    if numerator < MIN_EFFECTIVE:
        doubts.append(
            f"only {numerator:.0f} effective draws lie near the central point, "
            f"fewer than {MIN_EFFECTIVE}: draw more"
        )
    if denominator < MIN_EFFECTIVE:
        doubts.append(
            f"the proposals have an effective number of {denominator:.0f}, fewer than "
            f"{MIN_EFFECTIVE}: raise n_proposals, or reparametrise towards a Gaussian posterior"
        )
    doubts += sorted({fold.disagreement for fold in folds if fold.disagreement})[-1:]
    settings = {
        "n_blocks": 1,
        "scale": math.sqrt(folds[0].scale * folds[1].scale),
        "n_proposals": sum(fold.n_proposals for fold in folds),
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
            f"the weakest of the separate estimates rests on {effective:.0f} effective draws, "
            f"fewer than {MIN_EFFECTIVE}: raise n_proposals and draw more, or reparametrise "
            "towards a Gaussian posterior"
        )
    if n_moves < MIN_MOVES:
        doubts.append(
            f"the walkers of a reduced run moved {n_moves:.1f} times, fewer than {MIN_MOVES}: "
            "raise n_proposals, or reparametrise towards a Gaussian posterior"
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
    """The average of two independent estimates of the log-evidence."""
    error = math.hypot(*(fold.se for fold in folds))  # of their difference and of their sum
    gap = abs(folds[0].log_evidence - folds[1].log_evidence) / error
    if gap > MAX_GAP:
        doubts = [*doubts, f"the halves of the draws differ by {gap:.1f} standard errors"]
    log_evidence = float(np.mean([fold.log_evidence for fold in folds]))
    return Estimate(log_evidence, error / 2, settings, tuple(doubts))


def _effective(halves: Iterable[float]) -> float:
    """Effective sample size of the average of two independent means."""
    return 4 / sum(1 / number for number in halves)
