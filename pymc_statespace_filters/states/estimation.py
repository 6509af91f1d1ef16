"""Filtered and smoothed states at draws of the posterior."""

import json
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from ..pymc_model.checked_model import checked_model
from ..pymc_model.in_step import shared_by_ranks
from ..pymc_model.observation_moments import sensors_of_states
from ..pymc_model.state_space_variable import smoothing_method
from ..system.checks import check_random_seed
from ..system.own_units import in_own_units, moments_in_own_units
from ..system.steps import check_at, rows_at
from .draws import select_draws
from .groups import add_group, results_by_row, times_of
from .variable import VariableAtDraws, select_variables


@shared_by_ranks
def filtered_states(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    var_name: str | None = None,
    filter: Any = None,
    at: str = "observations",
    new_data: bool = False,
    n_draws: int | None = None,
    random_seed: int | np.random.Generator | None = None,
    extend_inferencedata: bool = True,
    progressbar: bool = True,
    comm: Any = None,
) -> xr.DataTree:
    """Estimate states given the observations up to their time, at draws of the posterior.

    Parameters
    ----------
    idata : xarray.DataTree
        Posterior draws from any sampler.
    model : pymc.Model, optional
        The model of the draws; by default that of the ``with`` block.
    var_name : str, optional
        Name of a StateSpace variable; all of them by default.
    filter : a filter of the package, such as EKF, GuidedPF, IMM or FiniteStateFilter, optional
        A filter to use instead of that of the variable.
    at : {"observations", "steps"}
        Times of the states: those of the observations, or every step from 0 to the last
        observation.
    new_data : bool
        Whether the data of the model are other ones than those of the draws, on purpose.
    n_draws : int, optional
        Number of draws, spread evenly over every chain; all by default.
    random_seed : None, int or numpy.random.Generator
        Seed of the drawn states, and of the filter's noise where none is stored.
    extend_inferencedata : bool
        Whether to add the group to `idata`; otherwise it is returned in a new DataTree.
    progressbar : bool
        Whether to show a progress bar if the work takes more than two seconds.
    comm : mpi4py.MPI.Comm, "world" or mapping, optional
        Ranks among which the draws are divided, as in `sample_dram`; the result does not depend
        on their number. A rank whose ``idata`` is None gets that of the first.

    Returns
    -------
    xarray.DataTree
        None on ranks that do not get it.
        With the group ``filtered_states``. For a variable "d": ``d_mean`` and ``d_sd``, mean and
        standard deviation of the state given the parameters of the draw; ``d_states``, one state
        drawn from that distribution, so that all draws together follow the posterior distribution
        of the state; dims (chain, draw, d_time, state). ``d_n_effective`` (chain, draw, d_time) is
        the effective number of particles or members, infinite for a deterministic filter. All are
        NaN where the filter failed. Over all draws, the posterior mean is the mean of ``d_mean``,
        and the variance is the mean of ``d_sd**2`` plus the variance of ``d_mean``. Those of a
        drifting parameter are of a normal law on its scale, see `drifting`. Of a panel the
        dimension is d_obs, the rows of all records, with the coordinates ``d_panel`` and
        ``d_time``.

    Raises
    ------
    ModelError
        If draws, model and settings are inconsistent.
    DataMismatchError
        If the draws are those of another model or, unless ``new_data``, of other data.

    Warns
    -----
    FilterWarning
        If the filter failed, or its particles collapsed, at some draws.

    Notes
    -----
    A noisy filter uses the noise of the draw's own likelihood estimate (``sample_stats["d_seed"]``)
    if it is stored.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> walk = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.5]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> with pm.Model() as model:
    ...     a = pm.Uniform("a", 0, 1)
    ...     d = psf.StateSpace("d", walk, psf.EKF(), steps=[0, 2, 4], observed=[0.3, 1.2, 0.8])
    ...     idata = psf.sample_dram(200, tune=200, chains=2, random_seed=1, progressbar=False)
    >>> idata = psf.filtered_states(idata, model, at="steps", random_seed=2)
    >>> idata["filtered_states"]["d_mean"].sizes
    Frozen({'chain': 2, 'draw': 200, 'd_time': 5, 'state': 1})
    """
    return _add_states(
        "filtered", idata, model, var_name, filter, at, new_data, n_draws, random_seed,
        extend_inferencedata, progressbar,
    )  # fmt: skip


@shared_by_ranks
def smoothed_states(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    var_name: str | None = None,
    filter: Any = None,
    at: str = "observations",
    new_data: bool = False,
    n_draws: int | None = None,
    random_seed: int | np.random.Generator | None = None,
    extend_inferencedata: bool = True,
    progressbar: bool = True,
    comm: Any = None,
) -> xr.DataTree:
    """Estimate states given all observations, at draws of the posterior.

    Parameters, errors and warnings are those of `filtered_states`.

    Returns
    -------
    xarray.DataTree
        With the group ``smoothed_states``, of the same form as `filtered_states`. The states of one
        draw in ``d_states`` are a joint path (with an ancestral smoother, within its lag). The
        attribute ``smoothing`` of ``d_states`` names the smoothing method of the filter.

    See Also
    --------
    filtered_states : States given the observations up to their time.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> walk = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.5]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> with pm.Model() as model:
    ...     a = pm.Uniform("a", 0, 1)
    ...     d = psf.StateSpace("d", walk, psf.EKF(), steps=[0, 2, 4], observed=[0.3, 1.2, 0.8])
    ...     idata = psf.sample_dram(200, tune=200, chains=2, random_seed=1, progressbar=False)
    >>> states = psf.smoothed_states(idata, model, random_seed=2)["smoothed_states"]
    >>> states["d_states"].sizes
    Frozen({'chain': 2, 'draw': 200, 'd_time': 3, 'state': 1})
    """
    return _add_states(
        "smoothed", idata, model, var_name, filter, at, new_data, n_draws, random_seed,
        extend_inferencedata, progressbar,
    )  # fmt: skip


def _add_states(
    moment: str,
    idata: xr.DataTree,
    model: pm.Model | None,
    var_name: str | None,
    filter: Any,
    at: str,
    new_data: bool,
    n_draws: int | None,
    random_seed: Any,
    extend_inferencedata: bool,
    progressbar: bool,
) -> xr.DataTree:
    model = checked_model(model, idata, any_filter=filter is not None, new_data=new_data)
    check_at(at)
    rng = check_random_seed(random_seed)
    draws = select_draws(idata, n_draws)
    parts = []
    for variable in select_variables(model, var_name, filter):
        at_draws = VariableAtDraws(model, variable, draws)
        steps = [rows_at(at, record.steps) for record in at_draws.records]
        with at_draws.progress("states", enabled=progressbar):
            states = [
                record.states(moment, rows, own)
                for rows, record, own in zip(
                    steps, at_draws.records, at_draws.generators(rng), strict=True
                )
            ]
        name, system = variable.name, variable.system
        own_units = [moments_in_own_units(system, one.mean, one.sd) for one in states]
        part = results_by_row(
            at_draws,
            times_of(at_draws, steps),
            {
                f"{name}_states": ("state", [in_own_units(system, one.drawn) for one in states]),
                f"{name}_mean": ("state", [mean for mean, _ in own_units]),
                f"{name}_sd": ("state", [sd for _, sd in own_units]),
                f"{name}_n_effective": ("", [one.n_effective for one in states]),
            },
        )
        part[f"{name}_states"].attrs = {
            "filter": repr(variable.filter),
            "observables": json.dumps(sensors_of_states(system)),
        }
        if moment == "smoothed":
            part[f"{name}_states"].attrs["smoothing"] = smoothing_method(variable)
        parts.append(part)
        at_draws.warn_about([one.health for one in states], [one.seeds for one in states])
    return add_group(idata, f"{moment}_states", xr.merge(parts), {"at": at}, extend_inferencedata)
