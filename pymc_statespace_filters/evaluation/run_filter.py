"""A run of a filter at fixed parameters, without PyMC: likelihood terms and filtered states."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evaluation.filter_warnings import warn_about, warn_of_choice
from pymc_statespace_filters.filters.protocol import Filter
from pymc_statespace_filters.ops.base import check_system_and_filter, evaluator
from pymc_statespace_filters.ops.states import FilterRun
from pymc_statespace_filters.system.model import StateSpaceModel
from pymc_statespace_filters.system.parameters import flat_parameters
from pymc_statespace_filters.system.record import check_at, check_seed, checked_record, rows_at


def run_filter(
    system: StateSpaceModel,
    filter: Filter,
    params: Mapping[str, Any],
    observed: Any,
    *,
    steps: Any = None,
    times: Any = None,
    inputs: Any = None,
    t0: float = 0.0,
    seed: int = 0,
    at: str = "observations",
) -> xr.Dataset:
    """Run a filter along a record at one value of each parameter, and return terms and states.

    Parameters
    ----------
    system : StateSpaceModel
    filter : EKF, UKF, IPLF, EnKF, BootstrapPF, GuidedPF, PFEnKF or GridFilter
    params : mapping
        A value for every parameter.
    observed, steps, times, inputs, t0
        The record, as in `log_likelihood`.
    seed : int
        Seed of the noise inside the filter, if it has any. The run is that of `log_likelihood` with
        this seed.
    at : {"observations", "steps"}
        When the states are kept: at the observations, or at every step from 0 to the last of them.

    Returns
    -------
    xarray.Dataset
        For the state given the observations up to its time: ``mean`` and ``sd`` (time, state), and
        the covariance ``cov`` (time, state, state_bis). With EnKF and the particle filters also
        ``particles`` (time, particle, state) and ``weights`` (time, particle) before resampling;
        the weights sum to one; a particle that is not finite has weight zero, and where none is
        finite mean and covariance are NaN. ``log_likelihood`` (obs_time) holds the terms
        log p(d_j | d_1 .. d_{j-1}). From an observation at which the filter fails on, terms are
        -inf and states NaN.

    Raises
    ------
    ModelError
        If an argument does not fit the system.

    Warns
    -----
    FilterWarning
        If the filter failed or its particles collapsed, if it linearises an equation that jumps
        as the state moves, or if its members are all the same.

    See Also
    --------
    log_likelihood : The terms alone, at many parameters.
    filtered_states : The states at draws of a posterior.

    Notes
    -----
    The particles of every time are stored: (states + 1) x particles x times x 8 bytes.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.5]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> run = psf.run_filter(system, psf.BootstrapPF(500), {"a": 0.9}, [0.3, 1.2], steps=[0, 3])
    >>> run["particles"].sizes
    Frozen({'time': 2, 'particle': 500, 'state': 1})
    """
    check_system_and_filter(system, filter)
    warn_of_choice(system, filter)
    check_at(at)
    record = checked_record(system, observed, steps=steps, times=times, inputs=inputs, t0=t0)
    theta = flat_parameters(system, params)
    if theta.ndim != 1:
        raise ModelError(
            f"run_filter takes one value per parameter, got arrays of {theta.shape[:-1]}"
        )
    noise = check_seed("seed", seed)
    if noise.ndim:
        raise ModelError(f"run_filter takes one seed, got an array of {noise.shape}")
    rows = rows_at(at, record.steps)
    evaluate = evaluator(FilterRun(system, filter))
    terms, health, *states = evaluate(theta, *record, noise, rows)
    warn_about(system, filter, health[None], lambda i: (theta, *record, noise))
    dataset = _dataset(system, *states).assign(log_likelihood=("obs_time", terms))
    seen = {"time": rows, "obs_time": record.steps}
    times_of = {name: record.t0 + at_steps * system.dt for name, at_steps in seen.items()}
    return dataset.assign_coords(times_of).assign_attrs(filter=repr(filter), at=at)


def _dataset(
    system: StateSpaceModel,
    mean: np.ndarray,
    cov: np.ndarray,
    members: np.ndarray,
    weights: np.ndarray,
) -> xr.Dataset:
    """States by time, with members if the filter has any."""
    variances = np.diagonal(cov, axis1=1, axis2=2)
    found: dict[str, tuple] = {
        "mean": (("time", "state"), mean),
        "sd": (("time", "state"), np.sqrt(np.maximum(variances, 0.0))),
        "cov": (("time", "state", "state_bis"), cov),
    }
    if weights.shape[1]:
        found["particles"] = (("time", "particle", "state"), members)
        found["weights"] = (("time", "particle"), weights)
    names = list(system.states)
    return xr.Dataset(found, coords={"state": names, "state_bis": names})
