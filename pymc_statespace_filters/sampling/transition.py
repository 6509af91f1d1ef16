"""One iteration of delayed rejection with a Gaussian random walk, around any log-density."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from pymc_statespace_filters.sampling.delayed_rejection import gaussian_log_acceptance


class EvaluatedPoint(NamedTuple):
    """A point with its estimate: whoever keeps the one keeps the other.

    Attributes
    ----------
    position : ndarray, shape (d,)
        On the unconstrained space.
    others : tuple of ndarray
        Values of the variables that other step methods move.
    seeds : tuple of ndarray of int64, shape ()
        The noise behind the estimate.
    log_density : float
    failure : int
        0, or the code of the reason why the log-density is minus infinity.
    n_effective : float
        Smallest effective number of particles behind the estimate; infinity if it has no noise.
    """

    position: np.ndarray
    others: tuple[np.ndarray, ...]
    seeds: tuple[np.ndarray, ...]
    log_density: float
    failure: int
    n_effective: float = np.inf


class Move(NamedTuple):
    """The outcome of an iteration.

    Attributes
    ----------
    point : EvaluatedPoint
        Where it ended.
    stage : int
        The stage whose proposal was accepted, 0 if none was.
    acceptance : float
        Probability of accepting the first stage's proposal.
    failures : tuple of int
        For each proposal evaluated, 0 or the code of its failure.
    """

    point: EvaluatedPoint
    stage: int
    acceptance: float
    failures: tuple[int, ...]


def delayed_rejection_move(
    evaluate: Callable[[np.ndarray, tuple[np.ndarray, ...]], EvaluatedPoint],
    current: EvaluatedPoint,
    chol: np.ndarray,
    stage_scale: float,
    normals: np.ndarray,
    log_uniforms: np.ndarray,
    seeds: Sequence[tuple[np.ndarray, ...]],
) -> Move:
    """Propose stage by stage until one is accepted or all are spent (thesis, Eqs. 3.30-3.32).

    The current point's estimate is used as it stands. A noisy likelihood has independent noise in
    each proposal, so that the densities of the noise cancel in Eq. 3.32 and the chain is exact for
    prior times expected likelihood, whatever the number of stages.

    Parameters
    ----------
    evaluate : callable
        ``evaluate(position, seeds)`` gives an ``EvaluatedPoint``.
    current : EvaluatedPoint
    chol : ndarray, shape (d, d)
        Lower Cholesky factor of the first stage's covariance.
    stage_scale : float
        Standard deviation of each stage relative to the one before.
    normals : ndarray, shape (stages, d)
        Standard normals, one row a stage.
    log_uniforms : ndarray, shape (stages,)
    seeds : sequence of tuple of ndarray
        Noise of each stage's proposal.

    Returns
    -------
    Move
    """
    n_stages = len(seeds)
    log_pi = np.empty(n_stages + 1)
    log_pi[0] = current.log_density
    offsets = np.zeros((n_stages + 1, normals.shape[1]))
    first_acceptance = 0.0
    failures: tuple[int, ...] = ()
    for stage in range(1, n_stages + 1):
        offsets[stage] = normals[stage - 1] * stage_scale ** (stage - 1)
        proposal = evaluate(current.position + chol @ offsets[stage], seeds[stage - 1])
        failures = (*failures, proposal.failure)
        log_pi[stage] = proposal.log_density
        log_alpha = gaussian_log_acceptance(log_pi, offsets, stage_scale, stage)
        if stage == 1:
            first_acceptance = float(np.exp(log_alpha))
        if log_uniforms[stage - 1] < log_alpha:
            return Move(proposal, stage, first_acceptance, failures)
    return Move(current, 0, first_acceptance, failures)
