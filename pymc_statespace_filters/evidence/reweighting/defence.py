"""Points that defend a reweighted posterior against what its draws have missed.

Draws have weights only where they are, so that no weight shows a mode that the approximate
posterior lacks or its chains have missed. Further points come from a density that is known
everywhere and much wider, a mixture of equal parts:

* the prior, if it can be sampled;
* the Student mixture fitted to the draws, three times as wide;
* this mixture as it is, which joins the points to the draws;
* a Student mixture fitted to a flattened copy of the approximate posterior;
* one fitted to a flattened copy of the exact posterior where there are no draws.

A flattened copy is a cloud of points, weighted by a power of the posterior density over the density
of the cloud: the largest power that leaves a fifth of the cloud. It enters by way of the fit alone,
so that the mixture has a known density whatever was found. The first cloud consists of the two wide
parts and costs evaluations of the approximate likelihood. The second one grows in rounds, each of
them guided by the fit to those before, and its points serve for nothing else.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from ...errors import ModelError
from ...statistics.student_mixture import StudentMixture
from ..estimators.student_mixture import flattened_copy
from ..posterior import Posterior, Prior

SCALE = 3.0  # of the wide part, in widths of the fit to the draws
N_CLOUD = 2000
N_ROUNDS, N_SEARCHED = 10, 50  # of the search by the exact likelihood; points in each

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Mixture:
    """Several normalised laws with equal weights, which have what a prior has."""

    parts: Sequence[Prior]

    def log_density(self, x: Array) -> Array:
        """Log-density of points x (m, k), shape (m,)."""
        of_parts = [part.log_density(x) for part in self.parts]
        return np.asarray(logsumexp(of_parts, axis=0) - np.log(len(self.parts)))

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Points (count, k), as many of each part, or one more, in random order."""
        shares = np.array_split(np.arange(count), len(self.parts))
        points = [p.sample(len(share), rng) for p, share in zip(self.parts, shares, strict=True)]
        return rng.permutation(np.concatenate(points))


def defensive_mixture(
    posterior: Posterior,
    fit: StudentMixture,
    level: float,
    exact: Callable[[Array], Array],
    rng: np.random.Generator,
) -> Mixture:
    """The mixture of wide parts.

    ``fit`` is the mixture fitted to the draws, whose log-density is below ``level`` where there are
    none; ``exact`` evaluates the exact log-density, or estimates it.
    """
    cloud = Mixture([*_proper_prior(posterior, rng), fit.widened(SCALE)])
    x = cloud.sample(N_CLOUD, rng)
    copy = flattened_copy(x, posterior.evaluate(x, rng) - cloud.log_density(x), rng)
    found: Sequence[Prior] = []
    x, log_ratio = x[:0], np.empty(0)
    for _ in range(N_ROUNDS):
        search = Mixture([*cloud.parts, *found, *found])
        new = search.sample(N_SEARCHED, rng)
        new = new[fit.log_density(new) < level]
        x = np.concatenate([x, new])
        log_ratio = np.append(log_ratio, exact(new) - search.log_density(new))
        found = flattened_copy(x, log_ratio, rng)
    return Mixture([*cloud.parts, fit, *copy, *found])


def _proper_prior(posterior: Posterior, rng: np.random.Generator) -> list[Prior]:
    """The prior, unless it is improper or its density is not that of its draws."""
    prior = posterior.required_prior
    try:
        prior.sample(N_CLOUD, rng)
    except ModelError:
        return []
    return [prior]
