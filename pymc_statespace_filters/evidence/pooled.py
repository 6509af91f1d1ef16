r"""Draws of a posterior and independent points as one sample, from a mixture of their two laws.

A chain has drawn n_1 points from an approximate posterior :math:`p_a(x) = a(x) / Z_a` of unknown
evidence :math:`Z_a`, and n_2 points come from a normalised density q. All of them together are a
sample of the mixture :math:`m = (n_1 p_a + n_2 q) / (n_1 + n_2)`, whichever law a point comes from
(the balance heuristic of Veach and Guibas 1995). Their weights for another density t are

.. math::

    w(x) = t(x) / m(x), \qquad E_m[w] = Z = \int t(x)\,dx ,

bounded wherever either law covers t: q defends against what the chain has missed (Hesterberg 1995),
and where q is low the weights are those of the chain alone, :math:`Z_a\,t / a`. :math:`Z_a` is
found by bridge sampling from the same points (Meng and Wong 1996): with the share
:math:`h = n_2 q / (n_1 p_a + n_2 q)`, the sum of h over the draws equals that of 1 - h over the
points of q (Shirts and Chodera 2008).

The errors follow from how each point moves the two equations: with :math:`D = \sum h (1 - h)`, a
draw moves :math:`\ln Z_a` by :math:`-h / D` and a point of q by :math:`(1 - h) / D`. The variance
of the sum of these influences is that of independent points for q; for the draws, that of
autocorrelated chains or of independent populations (`mcse`).

Where a or t is a noisy estimate, x stands for a point with its noise: the draws have the estimates
stored by the chain, the points of q fresh ones, and t has fresh noise everywhere.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from ..statistics.importance import LogMean, bridge_constant, log_mean, mcse, normalised

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pooled:
    """Draws (chain, draw) and points (m,) of q, the draws first and chain by chain."""

    shape: tuple[int, int]  # chains and draws; n in all are followed by the m points of q
    log_target: Array  # (n + m,), the log of t at all of them
    log_approximate: Array  # (n + m,), that of a
    log_q: Array  # (n + m,)
    population: NDArray[np.int64] | None = None  # (chain, draw), as in `Posterior`

    @property
    def n_draws(self) -> int:
        """The number of draws."""
        return self.shape[0] * self.shape[1]

    @cached_property
    def log_evidence_of_draws(self) -> float:
        """The logarithm of Z_a."""
        ratios, n = self.log_approximate - self.log_q, self.n_draws
        log_odds = math.log(n / (ratios.size - n))
        return bridge_constant(ratios[:n], ratios[n:], log_odds)

    @cached_property
    def log_weights(self) -> Array:
        """The logarithms of t / m at all points, whose mean is the evidence of t."""
        n, size = self.n_draws, self.log_q.size
        of_draws = self.log_approximate - self.log_evidence_of_draws + math.log(n / size)
        of_q = self.log_q + math.log(1 - n / size)
        return np.asarray(self.log_target - np.logaddexp(of_draws, of_q))

    @cached_property
    def log_draw_weights(self) -> Array:
        """The logarithms of t / a at the draws, (chain, draw)."""
        of_draws = slice(0, self.n_draws)
        ratio = self.log_target[of_draws] - self.log_approximate[of_draws]
        return np.asarray(ratio.reshape(self.shape))

    @cached_property
    def share_of_q(self) -> Array:
        """The share h of q in the mixture at every point."""
        n, m = self.n_draws, self.log_q.size - self.n_draws
        ratio = self.log_approximate - self.log_evidence_of_draws - self.log_q
        return np.asarray(expit(-ratio - math.log(n / m)))

    def log_evidence(self) -> LogMean:
        """The evidence of t."""
        weights = normalised(self.log_weights)
        return LogMean(log_mean(self.log_weights), self._error(weights, self._of_chain(weights)))

    def log_evidence_change(self) -> LogMean:
        """The evidence of t over that of a, from which the draws come."""
        weights = normalised(self.log_weights)
        change = log_mean(self.log_weights) - self.log_evidence_of_draws
        return LogMean(change, self._error(weights, self._of_chain(weights) - 1))

    def effective_size(self, x: Array) -> float:
        """The number of independent draws of t that would know the mean of x as well.

        x (n + m, k); the smallest number of its columns.
        """
        weights = normalised(self.log_weights)
        centred = x - weights @ x
        variances = weights @ centred**2
        influences = (weights[:, None] * centred).T
        errors = [self._error(one, self._of_chain(one)) for one in influences]
        return float(np.min(variances / np.square(errors)))

    def _of_chain(self, terms: Array) -> float:
        """How a sum of weighted terms changes with ln Z_a."""
        return float(terms @ (1 - self.share_of_q))

    def _error(self, terms: Array, by_constant: float) -> float:
        """Standard error of a sum of terms whose derivative by ln Z_a is given."""
        h, n = self.share_of_q, self.n_draws
        moves = np.concatenate([-h[:n], 1 - h[n:]]) / (h @ (1 - h))
        influence = terms + by_constant * moves
        of_draws = n * mcse(influence[:n].reshape(self.shape), self.population)
        of_points = math.sqrt(h.size - n) * float(influence[n:].std())
        return math.hypot(of_draws, of_points)
