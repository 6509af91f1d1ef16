r"""Whether the tails of a posterior hold more of it than the draws there tell.

Where chains enter a region rarely, they agree about its absence: R-hat is one, and estimates of the
evidence from the draws agree as well. But the evidence Z is an integral, which can be taken tail by
tail: with :math:`Z_T = \int_T e^{f(x)} dx` over a tail T, found by importance sampling in the tail
alone, and the share s of the draws there, the posterior has in the tail

.. math::

    p_T = Z_T / (Z_T + (1 - s) Z), \qquad f = \log \text{prior} + \log \text{likelihood},

where Z comes from the draws by bridge sampling. If the draws are those of the posterior,
:math:`p_T = s` within the errors. Proposals that do not reach all of a tail make Z_T too small;
therefore only a p_T that is too large says anything, and the weights are truncated (Ionides 2008),
which errs to the same side.

A tail is where a parameter, on the unconstrained space, lies beyond one of its quantiles. Only the
tails are looked at in which the log-density is highest: where the draws end although it does not
fall, as towards the neck of a funnel, something beyond may be missing.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import log_expit, stdtrit

from ...statistics.importance import (
    LogMean,
    bridge_constant,
    log_mean_of_draws,
    log_mean_of_independent,
    log_mean_of_truncated,
    mcse_of_chains,
)
from .tail_proposals import SIZES, Evaluate, Tail, WeightedPoints, weighted_points

SHARES = (0.2, 0.1, 0.05, 0.02)  # of the draws, in nested tails
MOST_PARAMETERS = 20  # beyond, importance weights are worth too little
N_BRIDGE = 8000
N_TAILS = 2  # that are looked at
FALSE_ALARMS = 0.02  # probability of a finding in any tail, if there is none
DEGREES_OF_FREEDOM = 30  # of the errors, of some hundred effective draws and points
MIN_MISSED, MIN_EFFECTIVE = 0.02, 50.0
MIN_DRAWS = 50  # different ones in a tail, at least
N_EVALUATIONS = N_BRIDGE + N_TAILS * sum(SIZES)
LEAST_SHARE = 0.2  # of these, with which the errors are not too large for a finding

Array = NDArray[np.float64]


class MissedTail(NamedTuple):
    """A tail that the draws have missed a part of.

    Attributes
    ----------
    tail : Tail
        On the unconstrained space, each parameter in standard deviations from its mean.
    draws : float
        Share of the draws in it.
    posterior : float
        Share of the posterior in it, at least.
    errors : float
        Their difference in standard errors.
    at_edge, furthest : ndarray (k,)
        The draw at the tail's edge, and the last draw in the tail.
    """

    tail: Tail
    draws: float
    posterior: float
    errors: float
    at_edge: Array
    furthest: Array


def missed_tails(
    draws: Array,
    log_density: Array,
    evaluate: Evaluate,
    n_evaluations: float,
    rng: np.random.Generator,
) -> list[MissedTail]:
    """Find the tails that hold more of the posterior than of the draws, the worst first.

    Parameters
    ----------
    draws : ndarray (chain, draw, k)
        On the unconstrained space.
    log_density : ndarray (chain, draw)
        Log-densities of the draws, Jacobians included; of noisy likelihoods, the chain's estimates.
    evaluate : callable
        ``evaluate(x, rng)`` returns the log-densities (m,) of points x (m, k), with fresh noise.
    n_evaluations : float
        How many points may be evaluated. With too few, nothing is found.
    rng : numpy.random.Generator
    """
    k = draws.shape[-1]
    part = min(1.0, n_evaluations / N_EVALUATIONS)
    centre, scale = draws.mean(axis=(0, 1)), draws.std(axis=(0, 1))
    if k > MOST_PARAMETERS or part < LEAST_SHARE or not (scale > 0).all():
        return []
    draws = (draws - centre) / scale

    def at(z: Array, rng: np.random.Generator) -> Array:
        return evaluate(centre + scale * z, rng)

    try:
        with np.errstate(over="ignore", invalid="ignore"):  # points far beyond the draws
            missed = _missed(draws, log_density, at, part, rng)
    except np.linalg.LinAlgError:  # draws that do not vary in every direction
        return []
    return [
        m._replace(at_edge=centre + scale * m.at_edge, furthest=centre + scale * m.furthest)
        for m in missed
    ]


def _missed(
    draws: Array, log_density: Array, evaluate: Evaluate, part: float, rng: np.random.Generator
) -> list[MissedTail]:
    """The tails of standardised draws; ``part`` of `N_EVALUATIONS` may be made."""
    log_evidence = _bridged(draws, log_density, evaluate, int(part * N_BRIDGE), rng)
    if log_evidence is None:
        return []
    found = []
    for index, side in _highest(draws, log_density):
        tails = [_tail(draws, index, side, share) for share in SHARES]
        inside = draws[tails[0].distance(draws) > 0]
        if len(np.unique(inside[:, index])) < MIN_DRAWS:
            continue
        points = weighted_points(tails[0], inside, evaluate, part, rng)
        found.append(max((_compared(t, draws, points, log_evidence) for t in tails), key=_errors))
    # Nested tails hold the same draws, and count as one; those not looked at do not count.
    limit = -stdtrit(DEGREES_OF_FREEDOM, FALSE_ALARMS / max(len(found), 1))
    missed = [m for m in found if m.errors > limit and m.posterior > m.draws + MIN_MISSED]
    return sorted(missed, key=_errors, reverse=True)


def _errors(missed: MissedTail) -> float:
    return missed.errors


def _highest(draws: Array, log_density: Array) -> list[tuple[int, int]]:
    """Parameter and side of the widest tails with the highest mean log-density."""
    k = draws.shape[-1]
    sides = [(index, side) for index in range(k) for side in (-1, 1)]
    inside = [_tail(draws, index, side, SHARES[0]).distance(draws) > 0 for index, side in sides]
    means = [float(log_density[one].mean()) if one.any() else -np.inf for one in inside]
    return [sides[i] for i in np.argsort(means)[::-1][:N_TAILS]]


def _tail(draws: Array, index: int, side: int, share: float) -> Tail:
    return Tail(index, side, float(np.quantile(side * draws[..., index], 1 - share)))


def _bridged(
    draws: Array, log_density: Array, evaluate: Evaluate, count: int, rng: np.random.Generator
) -> LogMean | None:
    """The log-evidence of the draws, from a normal distribution fitted to every other one."""
    k = draws.shape[-1]
    fitted, drawn, at_drawn = draws[:, ::2].reshape(-1, k), draws[:, 1::2], log_density[:, 1::2]
    chol = np.linalg.cholesky(np.atleast_2d(np.cov(fitted, rowvar=False)))
    centre = fitted.mean(axis=0)
    log_constant = -float(np.log(chol.diagonal()).sum()) - 0.5 * k * math.log(2 * math.pi)

    def log_normal(x: Array) -> Array:
        z = solve_triangular(chol, (x - centre).reshape(-1, k).T, lower=True)
        return (log_constant - 0.5 * (z**2).sum(axis=0)).reshape(x.shape[:-1])

    x = centre + rng.standard_normal((count, k)) @ chol.T
    return bridged(at_drawn - log_normal(drawn), evaluate(x, rng) - log_normal(x))


def bridged(at_drawn: Array, at_x: Array) -> LogMean | None:
    """The log-evidence from log-densities relative to those of proposals.

    At draws (chain, draw), and at points of the proposals (m,); None if all of these are -inf.
    """
    if np.isneginf(at_x).all():
        return None
    value = bridge_constant(at_drawn, at_x, 0.0)  # a rough one, of equal numbers
    of_draws = log_mean_of_draws(log_expit(value - at_drawn)).error
    of_points = log_mean_of_independent(log_expit(at_x - value)).error
    return LogMean(value, math.hypot(of_draws, of_points))


def _compared(
    tail: Tail, draws: Array, points: WeightedPoints, log_evidence: LogMean
) -> MissedTail:
    """Compare the shares of the draws and of the posterior in a tail."""
    distance = tail.distance(draws)
    inside = distance > 0
    share = float(inside.mean())
    if not 0 < share < 1:  # a chain that stands still may be all of a small tail
        return MissedTail(tail, share, 0.0, 0.0, draws[0, 0], draws[0, 0])
    x, order = draws[inside], np.argsort(distance[inside])
    mass = log_mean_of_truncated(np.where(tail.distance(points.x) > 0, points.log_weights, -np.inf))
    posterior = errors = 0.0
    if mass.n_effective > MIN_EFFECTIVE:
        ratio = math.exp(min(mass.value - log_evidence.value, 50.0)) / (1 - share)
        posterior = ratio / (1 + ratio)
        spread = posterior * (1 - posterior)
        of_masses = spread * math.hypot(mass.error, log_evidence.error)
        # The error of the draws' share, if the posterior's were true.
        of_draws = mcse_of_chains(inside.astype(np.float64))
        of_draws *= math.sqrt(max(spread / (share * (1 - share)), 1.0))
        errors = (posterior - share) / math.hypot(of_masses, of_draws)
    return MissedTail(tail, share, posterior, errors, x[order[0]], x[order[-1]])
