"""Whether the last particles of tempered SMC and the draws of the posterior lie in the same places.

The particles come from the prior and the draws from chains, so each can show what the other has
missed. Both together are divided into regions, without regard to which is which: by the components
of a mixture fitted to all of them, which separates modes, and by levels of log-density, which
separate a narrow peak or a long tail. The shares of particles and draws in each region are then
compared. The error of a share is that between the runs of the particles and that of autocorrelated
chains for the draws.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from ...student_mixture import fit_mixture, place_components, standardised
from ..posterior import Posterior
from .smc_moves import Particles

FALSE_ALARMS = 0.002  # probability of a difference in any region, if there is none
N_COMPONENTS = 8
MOST_FITTED = 2000  # particles, and draws, to which the mixture is fitted
LEVELS = (0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.98)  # probabilities of the levels of log-density
MIN_DIFFERENCE = 0.02  # of shares; a region of this size changes the log-evidence by as much
SMALLEST = 1e-3  # share that counts as none

Array = NDArray[np.float64]


class _Share(NamedTuple):
    """Share of the particles and of the draws in one region."""

    particles: float
    draws: float
    t: float  # their difference in units of its error

    @property
    def contrast(self) -> float:
        """How much of one of them the other has missed: the larger share, times the log ratio."""
        log_ratio = math.log((self.particles + SMALLEST) / (self.draws + SMALLEST))
        return max(self.particles, self.draws) * abs(log_ratio)


def compare_with_draws(
    particles: Particles, n_runs: int, posterior: Posterior, rng: np.random.Generator
) -> tuple[str, ...]:
    """Say which of the two has missed a region in which the other lies; empty if neither has."""
    regions = _regions(particles, posterior, rng)
    n_particles = len(particles.x)
    n_ancestors = len(np.unique(particles.ancestor))
    shares = [
        _share(
            inside[:n_particles].reshape(n_runs, -1),
            inside[n_particles:].reshape(posterior.log_density.shape),
            n_ancestors,
            posterior,
        )
        for inside in regions
    ]
    limit = student.isf(FALSE_ALARMS / (2 * max(len(shares), 1)), n_runs - 1)
    differing = [
        s for s in shares if abs(s.t) > limit and abs(s.particles - s.draws) > MIN_DIFFERENCE
    ]
    if not differing:
        return ()
    return (_sentence(max(differing, key=lambda share: share.contrast)),)


def _sentence(share: _Share) -> str:
    if share.particles < share.draws:
        return (
            f"the particles have missed a region of the posterior that the chains have found: "
            f"{share.draws:.1%} of the draws lie there and {share.particles:.1%} of the particles; "
            "raise n_particles, or use estimators that start from posterior draws"
        )
    return (
        f"the chains have missed a region of the posterior that the particles have found: "
        f"{share.particles:.1%} of the particles lie there and {share.draws:.1%} of the draws; "
        "run more chains, longer, from dispersed starting points"
    )


def _regions(
    particles: Particles, posterior: Posterior, rng: np.random.Generator
) -> list[NDArray[np.bool_]]:
    """Whether each of the particles and draws, concatenated, lies in each of the regions."""
    draws = posterior.draws.reshape(-1, posterior.draws.shape[-1])
    x = np.concatenate([particles.x, draws])
    log_density = np.concatenate(
        [particles.log_prior + particles.log_likelihood, posterior.log_density.ravel()]
    )
    levels = np.unique(np.quantile(log_density, LEVELS))
    regions = [log_density > level for level in levels]
    sample = np.concatenate([one[:: -(-len(one) // MOST_FITTED)] for one in (particles.x, draws)])
    if (fitted := standardised(sample)) is not None:
        mixture = fit_mixture(fitted.z, place_components(fitted.z, N_COMPONENTS, rng))
        component = mixture.affine(fitted.mean, fitted.chol).log_joint(x).argmax(axis=0)
        regions += [component == j for j in np.unique(component)]
    return regions


def _share(
    of_particles: NDArray[np.bool_],
    of_draws: NDArray[np.bool_],
    n_ancestors: int,
    posterior: Posterior,
) -> _Share:
    """Compare the shares of particles (run, particle) and draws (chain, draw) in a region."""
    by_run = of_particles.mean(axis=1)
    one, other = float(by_run.mean()), float(of_draws.mean())
    pooled = (of_particles.sum() + of_draws.sum()) / (of_particles.size + of_draws.size)
    # Runs that all miss a region have no spread: no error is below that of independent ancestors.
    least = math.sqrt(pooled * (1 - pooled) / n_ancestors)
    of_runs = max(float(by_run.std(ddof=1)) / math.sqrt(len(by_run)), least)
    error = of_runs
    if 0 < other < 1:
        error = math.hypot(error, posterior.mcse(of_draws.astype(np.float64)))
    return _Share(one, other, (one - other) / error if error else 0.0)
