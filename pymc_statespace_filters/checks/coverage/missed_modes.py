r"""Whether points on the way to a posterior lead to a part of it that the particles lack.

A narrow mode holds little of the tempered distributions, so that few particles meet it, and all
populations may lose them: their evidences then agree, and no spread shows what is missing. But the
points of the way are known. Where the posterior density at one of them is far above that of a
mixture fitted to the last particles, the surroundings are explored by adaptive importance sampling
(Cappe, Guillin, Marin and Robert 2004): Student distributions around the point, of scales a decade
apart, then such that are fitted to the weighted points which the mixture does not explain. They
give the integral :math:`Z_A` of prior times likelihood over an ellipsoid A, and the posterior has

.. math::

    p_A = Z_A / (Z_A + (1 - s) Z)

in it, with the share s of the particles and their evidence Z. If the particles are those of the
posterior, :math:`p_A = s` within the errors. Proposals that do not reach all of A make :math:`Z_A`
too small; therefore only a :math:`p_A` that is too large says anything, and the weights are
truncated. The place is named if :math:`p_A` exceeds s by more than 3 errors and by more than 0.05.
The same comparison is made at the narrowest component of the mixture, which particles have met, but
perhaps too few.

In `benchmarks.smc` this marks 11 of 14 runs that have lost a needle with 200 draws, and all of 6
with 1000. Of runs whose masses are within 3 errors, on all targets, it marks 2 of 113 and 0 of 119.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...smc.kernel import fitted_mixture
from ...smc.merging import mean_and_error, merged_index, merged_log_evidence
from ...smc.particles import Populations
from ...smc.temperature import next_temperature
from ...statistics.importance import LogMean, log_mean_of_truncated, normalised, systematic
from ...statistics.student_mixture import Standardised, StudentMixture, standardised
from .tail_proposals import Evaluate

MIN_EXCESS = math.log(20)  # of the posterior over the mixture, at a point worth a look
SCALES = 0.3, 0.1, 0.03, 0.01  # of the first proposals, in those of the cloud that met the point
WIDTHS = {0.4: 0.3, 1.0: 0.5, 2.0: 0.2}  # of the later ones, with their shares
SIZES = (100, 100, 100, 100, 200)  # points of each fit
LEAST_EVALUATIONS = SIZES[-1]  # with fewer nothing is looked at
N_PLACES = 2  # that are looked at
BEYOND = math.log(3)  # excess of points to which proposals are fitted
ESS_FRACTION, N_FITTED = 0.15, 400
MOST_FITTED = 4000  # particles
MIN_ERRORS, MIN_MISSED = 3.0, 0.05

Array = NDArray[np.float64]
type Excess = Callable[[Array, Array], Array]
"""Of log-densities (m,) at points (m, k) over those that the particles explain."""


class Visited(NamedTuple):
    """Points on the way, with their posterior densities and the stage that each was met in."""

    x: Array  # (n, k)
    log_density: Array  # (n,)
    stage: NDArray[np.int64]  # (n,)


def joined(parts: Sequence[Visited]) -> Visited:
    """The points of all parts."""
    return Visited(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def thinned(visited: Visited, most: int) -> Visited:
    """At most so many points: every other one of the stage with the most goes, first the earliest.

    A part of a stage says as much of where its points lie.
    """
    while len(visited.x) > most:
        of_stage = np.flatnonzero(visited.stage == np.bincount(visited.stage).argmax())
        kept = np.delete(np.arange(len(visited.x)), of_stage[1::2])
        visited = Visited(visited.x[kept], visited.log_density[kept], visited.stage[kept])
    return visited


class MissedMode(NamedTuple):
    """A place that the particles have missed a part of.

    Attributes
    ----------
    centre : ndarray (k,)
    share : float
        Of the particles, there.
    posterior : float
        Share of the posterior there, at least.
    errors : float
        Their difference in standard errors.
    """

    centre: Array
    share: float
    posterior: float
    errors: float

    @property
    def is_large(self) -> bool:
        """Whether it is more than chance and worth naming."""
        return self.errors > MIN_ERRORS and self.posterior > self.share + MIN_MISSED


class Place(NamedTuple):
    """An ellipsoid, and the log of the integral over it with its relative error."""

    centre: Array
    chol: Array
    log_integral: float
    error: float

    def holds(self, x: Array) -> NDArray[np.bool_]:
        """Whether points (n, k) lie within, that is nearly all of a normal distribution."""
        k = len(self.centre)
        z = np.linalg.solve(self.chol, (x - self.centre).T)
        return np.asarray((z**2).sum(axis=0) < k + 3 * math.sqrt(2 * k) + 4)


def missed_mode(
    populations: Populations,
    log_evidences: Array,
    visited: Visited,
    evaluate: Evaluate,
    n_evaluations: int,
    rng: np.random.Generator,
) -> MissedMode | None:
    """Look at the places where particles may be missing; the worst of those where they are.

    Parameters
    ----------
    populations : Populations
        The last particles.
    log_evidences : ndarray (R,)
        That each population has found.
    visited : Visited
    evaluate : callable
        ``evaluate(x, rng)`` returns the log-densities (m,) of points x (m, k), with fresh noise.
    n_evaluations : int
        How many points may be evaluated; without enough for one place, nothing is found.
    rng : numpy.random.Generator
    """
    n_fitted = min(MOST_FITTED, len(populations.particles.x))
    drawn = rng.permutation(merged_index(populations, log_evidences, n_fitted, rng))
    if (draws := standardised(populations.particles.x[drawn])) is None:
        return None
    mixture = fitted_mixture(draws, rng)
    total = float(merged_log_evidence(log_evidences)[0])

    def excess(x: Array, log_density: Array) -> Array:
        return np.asarray(log_density - mixture.log_density(x) - total)

    def places() -> Iterator[Place | None]:
        """The narrowest component, and what lies around the points of the highest excess."""
        if n_evaluations < LEAST_EVALUATIONS:
            return
        yield _narrowest(mixture, evaluate, rng)
        above = excess(visited.x, visited.log_density)
        for _ in range(min(N_PLACES, (n_evaluations - LEAST_EVALUATIONS) // sum(SIZES))):
            best = int(np.argmax(above))
            if not above[best] > MIN_EXCESS:
                return
            near = visited.x[visited.stage == visited.stage[best]]
            yield (place := explored(visited.x[best], near, excess, evaluate, rng))
            above[best] = -np.inf
            if place is not None:
                above[place.holds(visited.x)] = -np.inf

    def share(place: Place) -> Array:
        inside = place.holds(populations.particles.x).astype(np.float64)
        return mean_and_error(inside, populations, log_evidences)

    log_evidence = LogMean(*map(float, merged_log_evidence(log_evidences)))
    found = [
        compared(one, log_evidence, *map(float, share(one))) for one in places() if one is not None
    ]
    return max((m for m in found if m.is_large), key=lambda m: m.errors, default=None)


def _narrowest(
    mixture: StudentMixture, evaluate: Evaluate, rng: np.random.Generator
) -> Place | None:
    """The narrowest component of a mixture, which few particles may have met."""
    log_dets = np.log(np.diagonal(mixture.chols, axis1=1, axis2=2)).sum(axis=1)
    least = int(log_dets.argmin())
    mean, chol = mixture.means[least], mixture.chols[least]
    return _integrated(mean, chol, evaluate, rng)


def explored(
    start: Array, near: Array, excess: Excess, evaluate: Evaluate, rng: np.random.Generator
) -> Place | None:
    """What lies around a point of the posterior, met among others; None if nothing is found."""
    cloud = standardised(near)
    if cloud is None:
        return None
    centre, chol, widths = start, cloud.chol, dict.fromkeys(SCALES, 1 / len(SCALES))
    proposals: list[StudentMixture] = []
    x, log_density = np.empty((0, len(start))), np.empty(0)
    for size in SIZES[:-1]:
        proposals.append(_around(centre, chol, widths))
        new = proposals[-1].sample(size, rng)
        x = np.concatenate([x, new])
        log_density = np.append(log_density, evaluate(new, rng))
        of_proposals = np.logaddexp.reduce([q.log_density(x) for q in proposals])
        log_weights = log_density - of_proposals
        log_weights[excess(x, log_density) < BEYOND] = -np.inf
        fitted = _fitted(x, log_weights, rng)
        if fitted is None:
            return None
        centre, chol, widths = fitted.mean, fitted.chol, WIDTHS
    return _integrated(centre, chol, evaluate, rng)


def _around(centre: Array, chol: Array, widths: Mapping[float, float]) -> StudentMixture:
    """Student distributions around a point, of several widths with their weights."""
    scales = np.array(list(widths))[:, np.newaxis, np.newaxis] * chol
    return StudentMixture(
        np.array(list(widths.values())), np.tile(centre, (len(widths), 1)), scales
    )


def _fitted(x: Array, log_weights: Array, rng: np.random.Generator) -> Standardised | None:
    """Mean and covariance of weighted points, flattened where a few of them have all weight."""
    if np.isfinite(log_weights).sum() <= x.shape[1] + 1:
        return None
    power = next_temperature(0.0, log_weights, ESS_FRACTION)
    return standardised(x[systematic(normalised(power * log_weights), N_FITTED, rng)])


def _integrated(
    centre: Array, chol: Array, evaluate: Evaluate, rng: np.random.Generator
) -> Place | None:
    """The integral over an ellipsoid, from fresh points; None if none has a density."""
    place, proposals = Place(centre, chol, -math.inf, 0.0), _around(centre, chol, WIDTHS)
    x = proposals.sample(SIZES[-1], rng)
    log_weights = np.where(place.holds(x), evaluate(x, rng) - proposals.log_density(x), -np.inf)
    if np.isneginf(log_weights).all():
        return None
    mean = log_mean_of_truncated(log_weights)
    return place._replace(log_integral=mean.value, error=mean.error)


def compared(place: Place, log_evidence: LogMean, share: float, error: float) -> MissedMode:
    """Compare the share of the particles in a place, and its error, with that of the posterior."""
    ratio = math.exp(min(place.log_integral - log_evidence.value, 50.0))
    posterior = ratio / (ratio + 1 - share) if share < 1 else share
    of_posterior = posterior * (1 - posterior) * math.hypot(place.error, log_evidence.error)
    errors = (posterior - share) / max(math.hypot(of_posterior, error), 1e-9)
    return MissedMode(place.centre, share, posterior, errors)
