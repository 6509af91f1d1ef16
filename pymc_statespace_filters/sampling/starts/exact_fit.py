"""A record that the model fits exactly: the density has no bound, and there is no posterior."""

import math

import numpy as np
from numpy.typing import NDArray
from pymc.model import Model

from ...errors import ModelError
from ..target.target import Target

# On the unconstrained scale, from the lowest draw of the prior down to the points of the search: a
# factor of 1e6 of a positive variable.
_MARGIN = 14.0
# Logarithm of the errors of the model's predictions, relative to the spread of the data: errors of
# rounding are below it, those of the best instruments, in units that the prior did not expect, not.
_MOST_EXACT = -20.0


def check_fit(target: Target, found: NDArray[np.float64], log_density: NDArray[np.float64]) -> None:
    """Raise a `ModelError` if the points (m, d) of a posterior are those of an exact fit."""
    lowest = target.prior_draws.draws.min(axis=0)
    at_end = np.flatnonzero(np.median(found, axis=0) < lowest - _MARGIN)
    rvs = [target.raveled.rv_at(target.model, int(i)) for i in at_end]
    names = [rv.name for rv in rvs if target.model.rvs_to_transforms[rv] is not None]
    if names and _log_error(target.model, float(np.median(log_density))) < _MOST_EXACT:
        raise ModelError(
            "there is no posterior: the density has no bound towards the lower end of "
            f"{' and '.join(dict.fromkeys(names))}, because the model fits the record exactly, "
            "like one that is constant or was simulated without noise. Fix the noise of the sensor "
            "at its known accuracy (observation_noise=[[0.01**2]], say), or give the noise a prior "
            "that vanishes at zero, such as pm.InverseGamma(name, 3, 0.1)"
        )


def _log_error(model: Model, log_density: float) -> float:
    """The logarithm of the sd of normal errors with this density, over the spread of the data."""
    n, log_spread = 0, 0.0
    for rv in model.observed_RVs:
        columns = model.rvs_to_values[rv].eval(mode="FAST_COMPILE")
        for column in np.atleast_2d(columns.T):
            known = column[np.isfinite(column)]
            n += known.size
            log_spread += known.size * math.log(known.std() or np.abs(known).max() or 1.0)
    if n == 0:  # no data but Potentials
        return 0.0
    return -(log_density + log_spread) / n - 0.5 * math.log(2 * math.pi * math.e)
