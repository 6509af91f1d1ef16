"""Filter diagnostics: one-step-ahead predictions compared with the observations."""

from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from pymc_statespace_filters.diagnostics.calibration import (
    coverage_of,
    uniformity_of,
    whiteness_of,
)
from pymc_statespace_filters.diagnostics.innovations import (
    autocorrelation_of,
    input_correlation_of,
    inputs_before,
    lags_of,
    standardised,
)
from pymc_statespace_filters.diagnostics.predictions import (
    Calibration,
    calibration_by_rank,
    calibration_of,
    laws_of,
)
from pymc_statespace_filters.diagnostics.truncated_data import observed_values
from pymc_statespace_filters.evaluation.filter_warnings import warn_about
from pymc_statespace_filters.filters.outcomes import COLLAPSED
from pymc_statespace_filters.filters.protocol import HealthFilter
from pymc_statespace_filters.pymc_model.state_graphs import StateSpaceVariable
from pymc_statespace_filters.states.draws import PosteriorDraws, select_draws
from pymc_statespace_filters.states.groups import add_group
from pymc_statespace_filters.states.variable import (
    States,
    TermHealthAtDraws,
    VariableAtDraws,
    select_variables,
    simulate_observations,
)
from pymc_statespace_filters.system.accumulators import inputs_of_user
from pymc_statespace_filters.system.checks import check_random_seed

Array = NDArray[np.float64]

PROBS = (0.5, 0.9)  # of the prediction intervals
PREDICTION_NOTE = (
    "each observation is predicted from those before it, at parameters drawn from their posterior "
    "given all observations: the predictions are slightly better than real ones"
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
    """Compare each observation with its prediction from the observations before it.

    If filter and model are correct, the probability integral transform (PIT) of an observation, its
    rank among draws of its prediction, is uniform and independent of all others. Too narrow
    predictions give too many PIT values near 0 and 1, too wide ones too few; unmodelled dynamics
    give autocorrelation.

    The parameters are drawn from their posterior given all observations, as in posterior predictive
    checks. The predictions therefore use a little of the data they predict, and correct models
    appear slightly too good, the more so with fewer observations. `leave_future_out` scores models
    without this effect. Observations before the variable's ``score_from`` count as missing.

    Parameters
    ----------
    idata, model, var_name, filter, n_draws, extend_inferencedata, progressbar
        As in `filtered_states`.
    random_seed : None, int or numpy.random.Generator
        Seed of states, simulated observations and random tie-breaking.

    Returns
    -------
    xarray.DataTree
        With the group ``filter_diagnostics``. For a variable "d":

        * ``d_predicted`` (chain, draw, d_time, observable): a simulated observation of a state
          drawn given the earlier observations; NaN after a failure of the filter.
        * ``d_n_effective`` (chain, draw, d_time): the effective number of particles or members
          whose mean is the likelihood term of each observation; infinite for a deterministic
          filter, NaN where the observation is missing.
        * ``d_pit`` (d_time, observable): the probability of a prediction below the observation;
          NaN where the observation is missing. It is computed from the filter's own law of the
          prediction if that is known (Gaussian filters, `GridFilter`), else from the observation
          noise around the drawn states; for other noise it is the fraction of predictions not above
          the observation, with ties broken at random so that counts are uniform too.
        * ``d_residual`` (d_time, observable): the standard normal quantile of ``d_pit``.
        * ``d_clipped`` (d_time, observable): whether the residual is cut off, as the draws cannot
          tell how far out the observation is: it is at least so far.
        * ``d_innovation`` (d_time, observable), ``d_innovation_cov`` (d_time, observable,
          observable_bis): the observation minus the mean of its prediction, and the covariance of
          the prediction.
        * ``d_autocorrelation`` (lag, observable): of the innovations, each divided by its standard
          deviation. For a right model within 1.96 / sqrt(J) for 19 of 20 lags.
        * ``d_input_correlation`` (input_lag, input, observable), if the system has inputs: of these
          innovations with the input during the last step before the observation (lag 0), or before
          the observation so many earlier.
        * ``d_coverage`` (interval, observable): the fraction of observations within the central
          50 % and 90 % prediction intervals.
        * ``d_uniformity``, ``d_whiteness`` (observable): p-values of tests that ``d_pit`` is
          uniform (the test of ArviZ's PIT plots), and that ``d_residual`` has no autocorrelation
          (Ljung-Box, up to lag 10, missing ones dropped).
        * ``d_failed``, ``d_collapsed``: the fraction of draws at which the filter failed, and at
          which fewer than 3 effective particles decided some term.

        `plot_filter_health` plots the group. ArviZ plots the PIT alone by
        ``az.plot_ecdf_pit(idata, var_names="d_pit", group="filter_diagnostics",
        sample_dims=["d_time"])`` if no observation is missing.

    Raises
    ------
    ModelError
        If draws, model and settings are inconsistent, or the system defines the density of
        observations but no distribution to simulate them from.

    Warns
    -----
    FilterWarning
        If the filter failed, or its particles collapsed, at some draws.

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
        health = _term_health(at_draws, before, rng, progressbar)
        predicted = simulate_observations(
            at_draws, before.drawn, at_draws.steps, at_draws.inputs(), rng
        )
        observed = observed_values(model, variable.name)
        observed[: variable.score_from] = np.nan
        laws = laws_of(at_draws, observed, before)
        if laws is None:
            calibration = calibration_by_rank(predicted, observed, rng)
        else:
            calibration = calibration_of(laws, observed)
        part = _results_by_draw(variable, draws, at_draws, predicted, health)
        part = part.merge(_results_by_time(variable, calibration))
        parts.append(part.merge(_innovations(at_draws, observed, calibration)))
        arguments_of = at_draws.arguments_of(health.seeds)
        warn_about(variable.system, variable.filter, health.health, arguments_of)
    attrs = {"predictions": PREDICTION_NOTE}
    return add_group(idata, "filter_diagnostics", xr.merge(parts), attrs, extend_inferencedata)


def _term_health(
    at_draws: VariableAtDraws, before: States, rng: np.random.Generator, progressbar: bool
) -> TermHealthAtDraws:
    """Effective numbers behind the terms; of the filtered states if the filter does not tell."""
    filter = at_draws.variable.filter
    if isinstance(filter, HealthFilter):
        return at_draws.term_health(rng, progressbar=progressbar)
    states = before
    if filter.noisy:
        states = at_draws.states("filtered", at_draws.steps, rng, progressbar=progressbar)
    return TermHealthAtDraws(states.n_effective, states.health, states.seeds)


def _results_by_draw(
    variable: StateSpaceVariable,
    draws: PosteriorDraws,
    at_draws: VariableAtDraws,
    predicted: Array,
    health: TermHealthAtDraws,
) -> xr.Dataset:
    """Predictions and effective sample sizes of every draw; fractions of failed draws."""
    name, (time, observable) = variable.name, variable.dims
    smallest = np.fmin.reduce(health.n_effective, axis=1, initial=np.inf)
    found = draws.dataset(
        {
            f"{name}_predicted": ((time, observable), predicted),
            f"{name}_n_effective": ((time,), health.n_effective),
        },
        {
            time: at_draws.times(at_draws.steps),
            observable: list(variable.system.observables),
        },
    )
    found[f"{name}_predicted"].attrs = {"filter": repr(variable.filter)}
    found[f"{name}_failed"] = np.mean(health.health[:, 1] != 0)
    found[f"{name}_collapsed"] = np.mean(smallest < COLLAPSED)
    return found


def _results_by_time(variable: StateSpaceVariable, calibration: Calibration) -> xr.Dataset:
    """PIT values and residuals of the observations, their coverage and tests."""
    name, dims = variable.name, variable.dims
    pit, residual = calibration.pit, calibration.residual
    coverage = np.array([coverage_of(pit, prob) for prob in PROBS])
    uniformity = [uniformity_of(column) for column in pit.T]
    whiteness = [whiteness_of(column) for column in residual.T]
    return xr.Dataset(
        {
            f"{name}_pit": (dims, pit),
            f"{name}_residual": (dims, residual),
            f"{name}_clipped": (dims, calibration.clipped),
            f"{name}_coverage": (("interval", dims[1]), coverage),
            f"{name}_uniformity": (dims[1:], uniformity),
            f"{name}_whiteness": (dims[1:], whiteness),
        },
        coords={"interval": list(PROBS)},
    )


def _innovations(
    at_draws: VariableAtDraws, observed: Array, calibration: Calibration
) -> xr.Dataset:
    """Innovations, their covariance, and what they correlate with."""
    variable = at_draws.variable
    name, (time, observable), system = variable.name, variable.dims, variable.system
    innovation, bis = observed - calibration.mean, f"{observable}_bis"
    z, lags = standardised(innovation, calibration.cov), lags_of(len(observed))
    found = xr.Dataset(
        {
            f"{name}_innovation": ((time, observable), innovation),
            f"{name}_innovation_cov": ((time, observable, bis), calibration.cov),
            f"{name}_autocorrelation": (("lag", observable), autocorrelation_of(z, lags)),
        },
        coords={"lag": lags, bis: list(system.observables)},
    )
    if not system.n_inputs:
        return found
    # The mean over the draws, where inputs depend on them.
    given = inputs_of_user(system, at_draws.inputs())
    inputs = inputs_before(given.mean(axis=0), at_draws.steps)
    past = np.insert(lags, 0, 0)
    return found.assign(
        {
            f"{name}_input_correlation": (
                ("input_lag", "input", observable),
                input_correlation_of(z, inputs, past),
            )
        }
    ).assign_coords(input_lag=past, input=list(system.inputs))
