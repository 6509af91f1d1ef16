"""The check of integration steps at the end of a run: whether they move posterior or evidence.

First the steps are looked at along paths without noise, which costs next to nothing; densities are
compiled only where steps half as long are others.
"""

import numpy as np
from numpy.typing import NDArray
from pymc.model import Model
from xarray import DataTree

from ..errors import ModelError
from ..pymc_model.density import RowFunction
from ..pymc_model.inspection import noisy_filters
from ..pymc_model.posterior_draws import STEP_NATS, unconstrained_draws
from ..pymc_model.step_refinement import densities_by_halvings, step_accuracy, step_lengths
from ..statistics.importance import log_mean, normalised

_N_POINTS, _N_DRAWS = 10, 200
# Of the factors by which one step and two half as long multiply a deviation: that of Euler-Maruyama
# steps whose length times the rate is 0.4.
_LEAST_DIFFERENCE = 0.04
# The same of steps that are unstable, whose length times the rate is 2.
_UNSTABLE = 1.0
_MOST_SHIFT = 1.0  # standard deviations
_ROUNDING = 1e-12  # of the mean, for the standard deviation of draws that are all the same

Array = NDArray[np.float64]


def step_problems(tree: DataTree, model: Model) -> list[str]:
    """Say which integration steps are that are too long for the equations at the draws.

    By how many nats half the step changes the evidence is stored with the draws.
    """
    accuracy = step_accuracy(model)
    if accuracy is None:
        return []
    draws = unconstrained_draws(tree, model)
    draws = draws.reshape(-1, draws.shape[-1])
    differences = accuracy(_some(draws, _N_POINTS))
    if differences.max() < _LEAST_DIFFERENCE:
        return []
    too_long = (
        f"The integration steps of {max(step_lengths(model)):g} are too long for the equations here"
    )
    if np.median(differences) >= _UNSTABLE:
        return [
            f"{too_long}: a single one multiplies small deviations otherwise than two half as long."
            " Take LocalLinearization, which follows fast decays with long steps, or, where the "
            "noise depends on the state, multiply substeps by four until this warning is gone."
        ]
    shift, nats = _changes(model, _some(draws, _N_DRAWS))
    tree.attrs[STEP_NATS] = nats
    if shift >= _MOST_SHIFT:
        return [
            f"{too_long}: with steps half as long the posterior would move by {shift:.1f} standard "
            "deviations or more. Multiply substeps by four until this warning is gone, or take an "
            "integrator of higher order (ExactLinear for linear equations). psf.step_error "
            "measures the error of the log-likelihood and of the log-evidence."
        ]
    return []


def _changes(model: Model, x: Array) -> tuple[float, float]:
    """How far draws (n, k) move by half the step, in standard deviations, and the log-evidence.

    Both are 0 if that is unknown, as with a noisy filter: others than the filter of the draws may
    be far off.
    """
    nothing = 0.0, 0.0
    if noisy_filters(model):
        return nothing
    try:
        densities = densities_by_halvings(model, 1)
    except ModelError:  # a filter that does not take the system with substeps
        return nothing
    coarse, fine = (RowFunction(model, density).evaluate(x) for density in densities)
    is_known = np.isfinite(coarse)
    if not (is_known & np.isfinite(fine)).any():
        return nothing
    change = (fine - coarse)[is_known]
    weights, nats = normalised(change), log_mean(change)
    mean, spread = x[is_known].mean(axis=0), x[is_known].std(axis=0)
    varies = spread > _ROUNDING * np.abs(mean)
    moved = np.abs(weights @ x[is_known] - mean)[varies] / spread[varies]
    return float(np.nan_to_num(moved).max(initial=0.0)), nats


def _some(draws: Array, count: int) -> Array:
    return draws[np.linspace(0, len(draws) - 1, min(count, len(draws))).astype(int)]
