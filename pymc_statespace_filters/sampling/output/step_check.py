"""The check of integration steps at the end of a run: whether they move the posterior.

First the steps are looked at along paths without noise, which costs next to nothing; densities are
compiled only where steps half as long are others.
"""

import numpy as np
from numpy.typing import NDArray
from pymc.model import Model
from pymc.stats.convergence import SamplerWarning
from scipy.special import softmax
from xarray import DataTree

from ...pymc_model.density import RowFunction
from ...pymc_model.posterior_draws import unconstrained_draws
from ...pymc_model.step_refinement import densities_by_steps, step_accuracy, step_lengths
from .warnings import sampler_warning

_N_POINTS, _N_DRAWS = 10, 200
# Of the factors by which one step and two half as long multiply a deviation: that of Euler-Maruyama
# steps whose length times the rate is 0.4.
_LEAST_DIFFERENCE = 0.04
_MOST_SHIFT = 1.0  # standard deviations
_ROUNDING = 1e-12  # of the mean, for the standard deviation of draws that are all the same

Array = NDArray[np.float64]


def step_warnings(tree: DataTree, model: Model) -> list[SamplerWarning]:
    """Warn of integration steps that are too long for the equations at the draws."""
    accuracy = step_accuracy(model)
    if accuracy is None or not (lengths := step_lengths(model)):
        return []
    draws = unconstrained_draws(tree, model)
    draws = draws.reshape(-1, draws.shape[-1])
    if accuracy(_some(draws, _N_POINTS)).max() < _LEAST_DIFFERENCE:
        return []
    if (densities := densities_by_steps(model)) is None:
        return []
    x = _some(draws, _N_DRAWS)
    coarse, fine = (RowFunction(model, density).evaluate(x) for density in densities)
    is_known = np.isfinite(coarse)
    if not (is_known & np.isfinite(fine)).any():
        return []
    weights = softmax((fine - coarse)[is_known])
    mean, spread = x[is_known].mean(axis=0), x[is_known].std(axis=0)
    varies = spread > _ROUNDING * np.abs(mean)
    moved = np.abs(weights @ x[is_known] - mean)[varies] / spread[varies]
    shift = float(np.nan_to_num(moved).max(initial=0.0))
    if shift < _MOST_SHIFT:
        return []
    return [
        sampler_warning(
            f"The integration steps of {max(lengths):g} are too long for the equations here: with "
            f"steps half as long the posterior would move by {shift:.1f} standard deviations or "
            "more. Raise substeps, such as substeps=4, or take an integrator of higher order; "
            "psf.step_error tells whether they are short enough."
        )
    ]


def _some(draws: Array, count: int) -> Array:
    return draws[np.linspace(0, len(draws) - 1, min(count, len(draws))).astype(int)]
