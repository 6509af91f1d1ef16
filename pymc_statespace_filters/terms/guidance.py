"""The guide of the proposals, whatever the draws of the full model are worth.

Draws that are few, that have not converged or that belong to another model lead proposals away
from all that matters, in sub-models too, whose few points cannot tell. The full model can: its own
proposal has weights that are nearly equal where the draws are of its posterior. Otherwise its
proposal is fitted again, and points by weight take the place of the draws.
"""

import numpy as np

from ..evidence.estimators.student_mixture import flattened
from .proposals import Guide
from .screening import N_PILOT, Announce, improved, is_worthless
from .submodel_density import SubmodelDensity
from .submodel_evidence import Sampler, Weighted

# Effective points per point of the full model, below which the draws are replaced. Draws of the
# posterior have 0.1 to 0.6; those that are off by six standard deviations 0.005
# (`benchmarks.terms_poor_draws`).
POOR = 0.1
NO_GUIDE = 0.05  # below which even the best ones say nothing about sub-models
N_ROUNDS, N_POINTS = 8, 2000  # of replacing them, and points of the full model for that


def checked_guide(
    guide: Guide,
    density: SubmodelDensity,
    sampler: Sampler,
    rng: np.random.Generator,
    announce: Announce,
) -> tuple[Guide, Weighted]:
    """The guide, or a better one, and points of the full model that judge it."""
    best = at = guide, _full_model(guide, sampler)
    for _ in range(N_ROUNDS):
        if best[1].efficiency >= POOR:
            break
        announce("the full model", N_POINTS)
        [pilot] = improved([at[1].proposal], sampler, rng, announce)
        [points] = sampler.draw([pilot.proposal], [N_POINTS])
        if not np.isfinite(points.log_weights).any():
            break
        again = Guide.of_points(density, flattened(points.x, points.log_weights, rng), rng)
        at = again, _full_model(again, sampler)
        if at[1].efficiency > best[1].efficiency:
            best = at
        elif sampler.is_noisy and not is_worthless(best[1]):
            break  # Of the noise, which no draws mend.
    return best


def _full_model(guide: Guide, sampler: Sampler) -> Weighted:
    every = np.ones(len(guide.distances), dtype=bool)
    [points] = sampler.draw([guide.proposal(every)], [N_PILOT])
    return points
