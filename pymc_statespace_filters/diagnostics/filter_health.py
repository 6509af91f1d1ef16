"""Does a filter do its work, and does its model foretell the record one observation ahead."""

from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from pymc_statespace_filters.diagnostics.calibration import (
    coverage_of,
    pit_of,
    residual_of,
    uniformity_of,
    whiteness_of,
)
from pymc_statespace_filters.diagnostics.truncated_data import observed_values
from pymc_statespace_filters.evaluation.simulate import observer
from pymc_statespace_filters.pymc_model.inspection import COLLAPSED
from pymc_statespace_filters.pymc_model.state_graphs import StateSpaceVariable
from pymc_statespace_filters.states.draws import PosteriorDraws, select_draws
from pymc_statespace_filters.states.groups import add_group
from pymc_statespace_filters.states.variable import States, VariableAtDraws, select_variables
from pymc_statespace_filters.system.record import check_random_seed

Array = NDArray[np.float64]

PROBS = (0.5, 0.9)  # of the intervals whose coverage is counted
KNOWN = (
    "each observation is predicted from those before it, at parameters drawn from their posterior "
    "given the whole record: the predictions are slightly better than real ones"
)


def filter_diagnostics(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    var_name: str | None = None,
    filter: Any = None,
    n_draws: int | None = None,
    random_seed: int | np.random.Generator | None = None,
    extend_inferencedata: bool = True,
    progressbar: bool = True,
) -> xr.DataTree:
    """Predict each observation from those before it, and compare with what came.

    If filter and model are right, the place of an observation among draws of its prediction (the
    probability integral transform, PIT) is uniform, and independent of all others. Predictions that
    are too narrow put too many observations near 0 and 1, too wide ones too few; a model that lacks
    dynamics leaves autocorrelation.

    The parameters are drawn from their posterior given the whole record, as in posterior predictive
    checks, so that predictions know a little of what they predict: right models look slightly too
    good, the more so the shorter the record. `leave_future_out` scores models without that.

    Parameters
    ----------
    idata : xarray.DataTree
        Draws of the posterior, whoever made them.
    model : pymc.Model, optional
        The model of the ``with`` block if not given.
    var_name : str, optional
        A StateSpace variable; all of them if not given.
    filter : EKF, EnKF, BootstrapPF, PFEnKF or GridFilter, optional
        Another filter than the variable's own.
    n_draws : int, optional
        How many draws, spread evenly over every chain; all if not given.
    random_seed : None, int or numpy.random.Generator
        For states, simulated observations and the breaking of ties.
    extend_inferencedata : bool
        Whether `idata` gets the new group; otherwise a new DataTree has it alone.
    progressbar : bool
        Whether work of more than two seconds shows a bar.

    Returns
    -------
    xarray.DataTree
        With the group ``filter_diagnostics``. For a variable "d":

        * ``d_predicted`` (chain, draw, d_time, observable): a simulated observation of a state
          drawn given the observations before; NaN from a failure of the filter on.
        * ``d_n_effective`` (chain, draw, d_time): the effective number of particles or members that
          carry each observation's update, infinite for a deterministic filter.
        * ``d_pit`` (d_time, observable): the share of predictions not above the observation, ties
          broken at random so that counts are uniform too; NaN where it is missing.
        * ``d_residual`` (d_time, observable): the standard normal quantile of that share.
        * ``d_coverage`` (interval, observable): the share of observations within the central 50 %
          and 90 % of their predictions.
        * ``d_uniformity``, ``d_whiteness`` (observable): p-values of tests that ``d_pit`` is
          uniform (that of ArviZ's pictures), and that ``d_residual`` has no autocorrelation
          (Ljung-Box, up to lag 10, missing ones left out).
        * ``d_failed``, ``d_collapsed``: the share of draws at which the filter failed, and at which
          fewer than 3 effective particles were left at some observation.

        `plot_filter_health` draws it, and ArviZ the PIT alone, as
        ``az.plot_ecdf_pit(idata, var_names="d_pit", group="filter_diagnostics",
        sample_dims=["d_time"])`` where no observation is missing.

    Raises
    ------
    ModelError
        If draws, model and settings do not fit together, or the system has a density of
        observations but nothing to draw them from.

    References
    ----------
    C. Czado, T. Gneiting and L. Held, "Predictive model assessment for count data", *Biometrics* 65
    (2009). G. M. Ljung and G. E. P. Box, "On a measure of lack of fit in time series models",
    *Biometrika* 65 (1978).

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.5]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> record = psf.simulate(system, {"a": 0.8}, steps=range(40), random_seed=1)
    >>> with pm.Model() as model:
    ...     a = pm.Normal("a", 0, 0.5)
    ...     d = psf.StateSpace(
    ...         "d", system, psf.EKF(), steps=range(40), observed=record["observations"]
    ...     )
    ...     idata = psf.sample_dram(500, tune=500, random_seed=1, progressbar=False)
    >>> found = psf.filter_diagnostics(idata, model, random_seed=2)["filter_diagnostics"]
    >>> dict(found["d_pit"].sizes), bool(found["d_uniformity"].item() > 0.01)
    ({'d_time': 40, 'observable': 1}, True)
    """
    model = pm.modelcontext(model)
    rng = check_random_seed(random_seed)
    draws = select_draws(idata, n_draws)
    parts = []
    for variable in select_variables(model, var_name, filter):
        at_draws = VariableAtDraws(model, variable, draws)
        before = at_draws.states("predicted", at_draws.steps, rng, progressbar=progressbar)
        after = before
        if variable.filter.noisy:
            after = at_draws.states("filtered", at_draws.steps, rng, progressbar=progressbar)
        predicted = _observations(at_draws, before.drawn, rng)
        observed = observed_values(model, variable.name)
        part = _of_draws(variable, draws, at_draws, predicted, after)
        parts.append(part.merge(_of_record(variable, observed, predicted, rng)))
    attrs = {"predictions": KNOWN}
    return add_group(idata, "filter_diagnostics", xr.merge(parts), attrs, extend_inferencedata)


def _observations(at_draws: VariableAtDraws, states: Array, rng: np.random.Generator) -> Array:
    """An observation (draws, J, p) of each state (draws, J, n), NaN where that is."""
    system = at_draws.variable.system
    look, theta, rows = observer(system).function, at_draws.parameters(), at_draws.inputs()
    seen = np.full((*states.shape[:2], system.p), np.nan)
    for i, path in enumerate(states):
        known = np.isfinite(path).all(axis=1)
        inputs = rows[i if len(rows) > 1 else 0]
        seen[i, known] = look(
            rng, theta[i], path[known], at_draws.steps[known], inputs, at_draws.t0
        )
    return seen


def _of_draws(
    variable: StateSpaceVariable,
    draws: PosteriorDraws,
    at_draws: VariableAtDraws,
    predicted: Array,
    after: States,
) -> xr.Dataset:
    """What there is of every draw, and shares of the draws."""
    name, (time, observable) = variable.name, variable.dims
    smallest = np.fmin.reduce(after.n_effective, axis=1, initial=np.inf)
    found = draws.dataset(
        {
            f"{name}_predicted": ((time, observable), predicted),
            f"{name}_n_effective": ((time,), after.n_effective),
        },
        {
            time: at_draws.times(at_draws.steps),
            observable: list(variable.system.observables),
        },
    )
    found[f"{name}_predicted"].attrs = {"filter": repr(variable.filter)}
    found[f"{name}_failed"] = np.mean(after.health[:, 1] != 0)
    found[f"{name}_collapsed"] = np.mean(smallest < COLLAPSED)
    return found


def _of_record(
    variable: StateSpaceVariable, observed: Array, predicted: Array, rng: np.random.Generator
) -> xr.Dataset:
    """Where the observations fall, and what tests make of it."""
    name, dims = variable.name, variable.dims
    pit = pit_of(observed, predicted, rng)
    residual = residual_of(pit, len(predicted))
    coverage = np.array([coverage_of(pit, prob) for prob in PROBS])
    uniformity = [uniformity_of(column) for column in pit.T]
    whiteness = [whiteness_of(column) for column in residual.T]
    return xr.Dataset(
        {
            f"{name}_pit": (dims, pit),
            f"{name}_residual": (dims, residual),
            f"{name}_coverage": (("interval", dims[1]), coverage),
            f"{name}_uniformity": (dims[1:], uniformity),
            f"{name}_whiteness": (dims[1:], whiteness),
        },
        coords={"interval": list(PROBS)},
    )
