"""Chib and Jeliazkov's two means with all parameters in one block (thesis, Eq. 3.44)."""

import math
from dataclasses import dataclass

import numpy as np

from pymc_statespace_filters.errors import DataMismatchError
from pymc_statespace_filters.evidence.estimators.random_walk_proposal import Proposal
from pymc_statespace_filters.evidence.log_mean import (
    LogMean,
    log_mean_of_chains,
    log_mean_of_independent,
)
from pymc_statespace_filters.evidence.posterior import Posterior


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
        proposal.log_arriving(posterior.log_density) + proposal.log_q(posterior.draws)
    )

    # Denominator: draws from q(x*, .), with fresh log-densities.
    log_alpha = proposal.log_leaving(posterior.evaluate(proposal.sample(n_proposals, rng), rng))
    denominator = log_mean_of_independent(log_alpha)
    if np.isneginf(denominator.value):
        raise DataMismatchError(
            f"none of {n_proposals} proposals around the draws has a density: idata belongs to "
            "another model or to other data"
        )
    log_evidence = proposal.log_density - numerator.value + denominator.value
    impossible = float(np.isneginf(log_alpha).mean())
    return OneBlockEstimate(log_evidence, proposal.scale, numerator, denominator, impossible)
