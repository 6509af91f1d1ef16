"""The random-walk proposal q of Chib and Jeliazkov's identity: its centre and its width.

The centre x* may be any point; it affects only the error. Several candidates are compared, because
each fails for some posterior: the mean and the median are the most stable, but lie in the hole of a
ring or between two modes; the centres of two clusters of draws lie in two modes if these are far
apart; the draw of largest log-density never lies in a hole, but far from the centre in many
dimensions, and with a noisy likelihood its estimate is biased upwards. The log-density at each
candidate is averaged over fresh estimates and candidates in holes are discarded. The candidate with
the smallest predicted error of the evidence is chosen, then the width.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from ...errors import DataMismatchError
from ...statistics.importance import bridge_constant, log_mean, log_mean_of_draws
from ..posterior import Posterior
from .stopping import ratio_of_errors
from .whitening import BLOCK, NormalProposals, Whitening, moments

SCALES = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8)
N_PILOT = BLOCK  # evaluations to choose the scale, not used for the estimate
N_REPEATS = 20  # fresh estimates averaged into f(x*) of a noisy likelihood
N_CLUSTERS = 2
N_CLUSTERED = 4000  # draws to be clustered, at most
HOLE = 0.1  # quantile of the draws' log-densities below which a centre lies in a hole
MAX_LOG = 200.0  # avoids overflow of a useless relative variance
MIN_PROPOSALS = 500  # of the default
MAX_ERROR_RATIO = 1 / 3  # error of the denominator over that of the numerator
NEGLIGIBLE = 0.01  # nats, an error that needs no more evaluations
ROUNDING = 1e-9
MARGIN = 0.9  # of the target, because the error is only predicted

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Proposal:
    """q(x*, .) = N(x*, s^2 C), with the log-density at x*, a constant in all terms."""

    point: Array  # (k,)
    log_density: float
    chol: Array  # (k, k), of C
    scale: float = 1.0

    def log_q(self, x: Array) -> Array:
        """Log q(x, x*) of x (..., k)."""
        k = len(self.point)
        z = Whitening(self.point, self.chol).whitened(x.reshape(-1, k)) / self.scale
        log_det = np.log(np.diag(self.chol)).sum() + k * np.log(self.scale)
        log_q = -0.5 * (z**2).sum(axis=1) - 0.5 * k * np.log(2 * np.pi) - log_det
        return log_q.reshape(x.shape[:-1])

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw from q(x*, .), shape (count, k)."""
        z = rng.standard_normal((count, len(self.point)))
        return self.point + self.scale * z @ self.chol.T

    def log_alpha_from_center(self, log_density: Array) -> Array:
        """Log alpha(x*, x), given the log-densities of x; -inf where the density is zero."""
        return np.minimum(0.0, log_density - self.log_density)

    def log_alpha_to_center(self, log_density: Array) -> Array:
        """Log alpha(x, x*), given the log-densities of x."""
        return np.minimum(0.0, self.log_density - log_density)


@dataclass(frozen=True)
class ProposalPlan:
    """A proposal, the number of draws to take from it, and the predicted standard error."""

    proposal: Proposal
    n_proposals: int
    se: float


def plan_proposal(
    posterior: Posterior,
    pilot: NormalProposals,
    *,
    n_proposals: int | None,
    most: int,
    target_se: float | None = None,
    rng: np.random.Generator,
) -> ProposalPlan:
    """Choose x*, the scale s and the number of proposals for the smallest predicted error.

    The draws must not be those to be averaged: a plan fitted to them would bias the estimate. By
    default the number of proposals is that for which the denominator's error is a third of the
    numerator's, or negligible, and at most ``most``. With a target it is that for which the whole
    error is a little below ``target_se``, or the numerator's dominates. ``pilot`` has proposals
    fitted to the draws.
    """
    candidates = _candidates(posterior, rng)
    log_evidence = _pilot(posterior, pilot)
    enough = NEGLIGIBLE if target_se is None else MARGIN * target_se

    def planned(proposal: Proposal) -> ProposalPlan:
        numerator, relative = _predicted_variances(proposal, posterior, log_evidence)
        ratio, left = MAX_ERROR_RATIO, enough**2
        if target_se is not None:
            ratio, left = ratio_of_errors(target_se, numerator**0.5), enough**2 - numerator
        allowed = max(ratio**2 * numerator, left)
        count = n_proposals or math.ceil(np.clip(relative / allowed, MIN_PROPOSALS, most))
        return ProposalPlan(proposal, count, float(np.sqrt(numerator + relative / count)))

    def rank(plan: ProposalPlan) -> tuple[float, int, float]:
        """Of errors that are small enough, the one of the fewest proposals."""
        return max(plan.se, (1 + ROUNDING) * enough), plan.n_proposals, plan.se

    best = min(map(planned, candidates), key=rank).proposal
    return min((planned(replace(best, scale=scale)) for scale in SCALES), key=rank)


def _candidates(posterior: Posterior, rng: np.random.Generator) -> list[Proposal]:
    """Points in the bulk of the draws with their log-densities, densest first."""
    k = posterior.draws.shape[-1]
    draws = posterior.draws.reshape(-1, k)
    coordinates = moments(draws)
    few = draws[:: -(-len(draws) // N_CLUSTERED)]
    centres, _ = kmeans2(coordinates.whitened(few), N_CLUSTERS, minit="++", rng=rng)
    points = np.stack(
        [
            coordinates.mean,
            np.median(draws, axis=0),
            *coordinates.unconstrained(centres),
            draws[posterior.log_density.argmax()],
        ]
    )

    # A noisy likelihood is averaged, so that f(x*) is a typical value.
    n_repeats = N_REPEATS if posterior.is_noisy else 1
    log_density = posterior.evaluate(np.repeat(points, n_repeats, axis=0), rng)
    constants = [log_mean(estimates) for estimates in log_density.reshape(len(points), -1)]

    found = [
        Proposal(point, constant, coordinates.chol)
        for point, constant in zip(points, constants, strict=True)
        if np.isfinite(constant)
    ]
    if not found:
        raise DataMismatchError(
            "the model has zero density at the mean, the median and the best of the draws: "
            "idata belongs to another model or to other data"
        )
    floor = min(np.quantile(posterior.log_density, HOLE), max(p.log_density for p in found))
    dense = [candidate for candidate in found if candidate.log_density >= floor]
    return sorted(dense, key=lambda candidate: -candidate.log_density)


def _pilot(posterior: Posterior, pilot: NormalProposals) -> float:
    """Estimate the log-evidence roughly, by bridge sampling to the Gaussian of the draws.

    It needs no centre x*.
    """
    draws = posterior.draws.reshape(-1, posterior.draws.shape[-1])
    normal = Proposal(pilot.moments.mean, 0.0, pilot.moments.chol)
    sampled, at_sampled = pilot.first(N_PILOT)
    ratio_drawn = posterior.log_density.ravel() - normal.log_q(draws)
    if np.isneginf(at_sampled).all():
        return float(np.median(ratio_drawn))
    return bridge_constant(ratio_drawn, at_sampled - normal.log_q(sampled), 0.0)


def _predicted_variances(
    proposal: Proposal, posterior: Posterior, log_evidence: float
) -> tuple[float, float]:
    """Predict relative variances from the draws alone, given a rough log-evidence.

    Returns the variance of the numerator's mean and that of one term of the denominator. The
    moments of the latter follow from the draws: with D the mean of alpha(x*, x) over q, and pi the
    posterior,

        D = p(D) / e^f(x*) E_pi[alpha(x, x*) q(x, x*)],
        E_q[alpha(x*, x)^2] = p(D) / e^f(x*) E_pi[exp(-|f(x) - f(x*)|) q(x, x*)].
    """
    log_q = proposal.log_q(posterior.draws)
    numerator = log_mean_of_draws(proposal.log_alpha_to_center(posterior.log_density) + log_q)
    second = log_mean(log_q - np.abs(posterior.log_density - proposal.log_density))
    log_ordinate = proposal.log_density - log_evidence  # of the posterior density
    log_relative = min(second + log_ordinate - 2 * numerator.value, MAX_LOG)
    return numerator.error**2, max(float(np.exp(log_relative)) - 1, 0.0)
