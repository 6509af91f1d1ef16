"""R-hat and effective sample size of the chains of a model, for each element of their position."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .datatree import most_iterations

# Above this R-hat the chains disagree: the limit of `pm.sample` and of Vehtari and others (2021).
MAX_RHAT = 1.01
# Fewest draws of a chain from which ArviZ computes either.
FEWEST = 4
_TAILS = (0.05, 0.95)  # whose effective sample size is that of the tails


class Convergence(NamedTuple):
    """Diagnostics of all chains together, on the unconstrained space.

    The effective sample sizes are ArviZ's "bulk" and "tail", R-hat its "rank": the larger one of
    the ranks and of the distances from the median ("folded"). Effective sample sizes are the same
    for a parameter as for its logarithm; R-hat may differ there in the third decimal.
    """

    ess: np.ndarray  # (d,), bulk, 0 where no chain has moved
    tail: np.ndarray  # (d,), of the quantiles of 5 and 95 %
    rhat: np.ndarray  # (d,), infinity where no chain has moved

    def reaches(self, until_ess: float, most_rhat: float = MAX_RHAT) -> bool:
        """Whether every effective sample size is large enough, and no R-hat too large."""
        return bool(self.least_ess >= until_ess and self.rhat.max() <= most_rhat)

    @property
    def least_ess(self) -> float:
        """The smallest effective sample size, of bulk and tails."""
        return float(min(self.ess.min(), self.tail.min()))

    def described(self, names: Sequence[str]) -> str:
        """Name the smallest effective sample size and the largest R-hat, and whose they are."""
        least, tail, most = int(self.ess.argmin()), int(self.tail.argmin()), int(self.rhat.argmax())
        return (
            f"the smallest bulk effective sample size is {self.ess[least]:.0f} ({names[least]}), "
            f"the smallest of the tails {self.tail[tail]:.0f} ({names[tail]}), "
            f"the largest R-hat {self.rhat[most]:.3f} ({names[most]})"
        )


def convergence(chains: Sequence[np.ndarray], most_draws: int | None = None) -> Convergence | None:
    """Compute the diagnostics of chains, shape (n, d) each; None for fewer than four draws.

    Of chains of different lengths those are compared that Ctrl-C would return, cut to one length. A
    single chain is compared with itself: R-hat is that of its two halves. If they have more than
    ``most_draws``, every second, third, ... draw is taken; the effective sample size is then a
    little too small.
    """
    kept, n = most_iterations([len(positions) for positions in chains])
    if n < FEWEST:
        return None
    rows = slice(0, n, 1 if most_draws is None else -(-n // most_draws))
    elements = range(chains[0].shape[1])  # one by one, which takes the least memory
    values = [_of_element(np.stack([chains[c][rows, i] for c in kept])) for i in elements]
    return Convergence(*np.transpose(values))


def _of_element(draws: np.ndarray) -> tuple[float, float, float]:
    """Effective sample sizes and R-hat of draws of one number, shape (chains, n)."""
    # It takes as long to import as the rest of what sampling needs, and the first diagnostics are
    # wanted while chains run.
    from arviz_stats.base import array_stats

    if np.ptp(draws) == 0.0:  # ArviZ takes these for independent draws
        return 0.0, 0.0, np.inf
    halves = draws[0, : draws.shape[1] // 2 * 2].reshape(2, -1)
    with np.errstate(invalid="ignore", divide="ignore"):  # chains that never moved
        ess, tail = (
            array_stats.ess(draws, chain_axis=0, draw_axis=1, method=method, prob=prob)
            for method, prob in (("bulk", None), ("tail", _TAILS))
        )
        compared = draws if len(draws) > 1 else halves
        rhat = array_stats.rhat(compared, chain_axis=0, draw_axis=1, method="rank")
    return float(ess), float(tail), float(rhat)
