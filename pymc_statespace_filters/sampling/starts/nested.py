"""A distribution from which a population is annealed if draws of some variables are known.

They are those of a posterior that lacks the other variables, such as that of a nested model. Their
product with the prior of the others is described by a mixture of Student-t distributions. A further
component covers the prior of all variables, as the posterior may lie far from the known draws.
"""

import numpy as np
from numpy.typing import NDArray

from ...errors import ModelError
from ...student_mixture import StudentMixture, fit_mixture, place_components, standardised

_N_COMPONENTS = 4  # of the known draws, which may have several modes
_PRIOR_WEIGHT = 0.2

Array = NDArray[np.float64]


def nested_reference(known: Array, prior: Array, rng: np.random.Generator) -> StudentMixture:
    """The mixture for draws (n, d) with columns of NaN, and draws of the prior (m, d)."""
    lacking = np.isnan(known[0])
    paired = prior[rng.integers(len(prior), size=len(known))]
    near = _fitted(np.where(lacking, paired, known), _N_COMPONENTS, rng)
    far = _fitted(prior, 1, rng)
    return StudentMixture(
        np.append((1 - _PRIOR_WEIGHT) * near.weights, _PRIOR_WEIGHT * far.weights),
        np.concatenate([near.means, far.means]),
        np.concatenate([near.chols, far.chols]),
    )


def _fitted(x: Array, n_components: int, rng: np.random.Generator) -> StudentMixture:
    draws = standardised(x)
    if draws is None:
        raise ModelError("pilot must have draws that vary in every direction")
    placed = place_components(draws.z, n_components, rng)
    return fit_mixture(draws.z, placed).affine(draws.mean, draws.chol)
