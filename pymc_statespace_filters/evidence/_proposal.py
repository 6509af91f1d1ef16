"""The random-walk proposal q of Chib and Jeliazkov's identity: its centre and its width."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.evidence._means import log_mean_of_chains, log_mean_of_independent
from pymc_statespace_filters.evidence.posterior import Posterior

SCALES = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8)
N_PILOT = 100  # proposals that serve the choice of the scale and are then thrown away
N_REPEATS = 20  # fresh estimates behind the constant of a noisy likelihood

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Proposal:
    """q(x*, .) = N(x*, s^2 C), with the one log-density that is used at x* everywhere."""

    point: Array  # (k,)
    log_density: float
    chol: Array  # (k, k), of C
    scale: float = 1.0

    def log_q(self, x: Array) -> Array:
        """Log q(x, x*) of x (..., k)."""
        k = len(self.point)
        z = solve_triangular(self.chol, (x - self.point).reshape(-1, k).T, lower=True) / self.scale
        log_det = np.log(np.diag(self.chol)).sum() + k * np.log(self.scale)
        log_q = -0.5 * (z**2).sum(axis=0) - 0.5 * k * np.log(2 * np.pi) - log_det
        return log_q.reshape(x.shape[:-1])

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw from q(x*, .), shape (count, k)."""
        z = rng.standard_normal((count, len(self.point)))
        return self.point + self.scale * z @ self.chol.T

    def log_leaving(self, log_density: Array) -> Array:
        """Log alpha(x*, x) for x of these log-densities; where there is no density it is -inf."""
        return np.minimum(0.0, log_density - self.log_density)

    def log_arriving(self, log_density: Array) -> Array:
        """Log alpha(x, x*) for x of these log-densities."""
        return np.minimum(0.0, self.log_density - log_density)


def choose_proposal(
    posterior: Posterior, *, n_proposals: int, rng: np.random.Generator
) -> Proposal:
    """Choose x* and the scale s for the smallest predicted error of the evidence.

    Candidates for x* are the mean, the median and the draw of largest stored log-density; each with
    every scale of `SCALES`.
    """
    candidates = _candidates(posterior, rng)
    log_evidence = _pilot(candidates[0], posterior, rng)
    options = [replace(candidate, scale=scale) for candidate in candidates for scale in SCALES]

    def predicted(option: Proposal) -> float:
        return _predicted_variance(option, posterior, log_evidence, n_proposals)

    return min(options, key=predicted)


def _candidates(posterior: Posterior, rng: np.random.Generator) -> list[Proposal]:
    """Points in the bulk of the draws, densest first, each with its constant log-density."""
    k = posterior.draws.shape[-1]
    draws = posterior.draws.reshape(-1, k)
    points = np.stack(
        [draws.mean(axis=0), np.median(draws, axis=0), draws[posterior.log_density.argmax()]]
    )
    try:
        chol = np.linalg.cholesky(np.cov(draws, rowvar=False).reshape(k, k))
    except np.linalg.LinAlgError:
        raise ModelError(
            "idata must hold draws that vary in every direction; the covariance of "
            f"{len(draws)} draws of {k} unconstrained parameters is singular"
        ) from None

    # A noisy likelihood is averaged, so that the constant is a typical value.
    n_repeats = N_REPEATS if posterior.is_noisy else 1
    log_density = posterior.evaluate(np.repeat(points, n_repeats, axis=0), rng)
    constants = [log_mean_of_independent(c).value for c in log_density.reshape(len(points), -1)]

    found = [
        Proposal(point, constant, chol)
        for point, constant in zip(points, constants, strict=True)
        if np.isfinite(constant)
    ]
    if not found:
        raise DataMismatchError(
            "the model gives no density at the mean, the median or the best of the draws: "
            "idata belongs to another model or to other data"
        )
    return sorted(found, key=lambda candidate: -candidate.log_density)


def _pilot(proposal: Proposal, posterior: Posterior, rng: np.random.Generator) -> float:
    """Estimate the log-evidence roughly, with few proposals."""
    arriving = proposal.log_arriving(posterior.log_density) + proposal.log_q(posterior.draws)
    leaving = proposal.log_leaving(posterior.evaluate(proposal.sample(N_PILOT, rng), rng))
    numerator, denominator = log_mean_of_chains(arriving), log_mean_of_independent(leaving)
    return proposal.log_density - numerator.value + max(denominator.value, -np.log(N_PILOT))


def _predicted_variance(
    proposal: Proposal, posterior: Posterior, log_evidence: float, n_proposals: int
) -> float:
    """Predict the variance of the log-evidence from the draws alone, given a rough log-evidence.

    The numerator is what it will be. The two moments of the denominator follow from it: with D the
    mean of alpha(x*, x) over q, and pi the posterior,

        D = p(D) / e^f(x*) E_pi[alpha(x, x*) q(x, x*)],
        E_q[alpha(x*, x)^2] = p(D) / e^f(x*) E_pi[exp(-|f(x) - f(x*)|) q(x, x*)].
    """
    log_q = proposal.log_q(posterior.draws)
    numerator = log_mean_of_chains(proposal.log_arriving(posterior.log_density) + log_q)
    second = log_mean_of_chains(log_q - np.abs(posterior.log_density - proposal.log_density))
    log_ordinate = proposal.log_density - log_evidence  # of the posterior density
    relative = np.exp(second.value + log_ordinate - 2 * numerator.value) - 1
    return float(numerator.error**2 + max(relative, 0.0) / n_proposals)
