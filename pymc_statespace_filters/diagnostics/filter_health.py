"""Filter diagnostics: one-step-ahead predictions compared with the observations."""

from typing import Any, NamedTuple

import numpy as np
import pymc as pm
import xarray as xr

from ..checks.filters.checks import stored
from ..checks.filters.finding import OFF
from ..errors import FilterWarning, warn
from ..filters.outcomes import COLLAPSED
from ..pymc_model.checked_model import checked_model
from ..pymc_model.state_space_variable import StateSpaceVariable
from ..states.draws import select_draws
from ..states.groups import add_group, by_record, results_by_row, times_of
from ..states.record import Array, RecordAtDraws, States, TermHealthAtDraws, simulate_observations
from ..states.variable import VariableAtDraws, select_variables
from ..system.checks import check_random_seed
from ..system.input_columns import inputs_of_user
from .calibration import (
    autocorrelation_of,
    coverage_of,
    input_correlation_of,
    inputs_before,
    lags_of,
    standardised,
    uniformity_of,
    whiteness_of,
)
from .predictions import Calibration, calibration_by_rank, calibration_of, laws_of

PROBS = (0.5, 0.9)  # of the prediction intervals
PREDICTION_NOTE = (
    "each observation is predicted from those before it, at parameters drawn from their posterior "
    "given all observations: the predictions are slightly better than real ones"
)
# At the draws that are taken of a long record: some 0.6 GB, and four seconds of an EKF.
_MOST_NUMBERS, _LEAST_DRAWS = 2e7, 40


def filter_diagnostics(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    var_name: str | None = None,
    filter: Any = None,
    new_data: bool = False,
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
    idata, model, var_name, filter, new_data, extend_inferencedata, progressbar
        As in `filtered_states`.
    n_draws : int, optional
        Number of draws to use, evenly from every chain. By default all of them, or of long records
        as many as need less than one gigabyte, and 40 at least: 160 of 20 000 rows of one state.
    random_seed : None, int or numpy.random.Generator
        Seed of states, simulated observations and random tie-breaking.

    Returns
    -------
    xarray.DataTree
        With the group ``filter_diagnostics``, whose attribute ``draws`` is the number of draws used
        and of all. For a variable "d":

        * ``d_predicted`` (chain, draw, d_time, observable): a simulated observation of a state
          drawn given the earlier observations; NaN after a failure of the filter.
        * ``d_n_effective`` (chain, draw, d_time): the effective number of particles or members
          whose mean is the likelihood term of each observation; infinite for a deterministic
          filter, NaN where the observation is missing.
        * ``d_pit`` (d_time, observable): the probability of a prediction below the observation;
          NaN where the observation is missing, and drawn from its interval where it is censored. It
          is computed from the filter's own law of the
          prediction if that is known (Gaussian filters, `GridFilter`), else from the observation
          noise around the drawn states; for other noise it is the fraction of predictions not above
          the observation, with ties broken at random so that counts are uniform too.
        * ``d_residual`` (d_time, observable): the standard normal quantile of ``d_pit``; NaN where
          the observation is censored.
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

        Of a panel the dimension of the rows is d_obs, with the coordinates ``d_panel`` and
        ``d_time``; correlations, coverage, p-values and fractions have the dimension d_record.

        `plot_filter_health` plots the group. ArviZ plots the PIT alone by
        ``az.plot_ecdf_pit(idata, var_names="d_pit", group="filter_diagnostics",
        sample_dims=["d_time"])`` if no observation is missing.

    Raises
    ------
    ModelError
        If draws, model and settings are inconsistent, or the system defines the density of
        observations but no distribution to simulate them from.
    DataMismatchError
        If the draws are those of another model or, unless ``new_data``, of other data.

    Warns
    -----
    FilterWarning
        If the filter failed, or its particles collapsed, at some draws; or if `check_filter` or the
        end of the run found it off.

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
    model = checked_model(model, idata, any_filter=filter is not None, new_data=new_data)
    rng = check_random_seed(random_seed)
    variables = select_variables(model, var_name, filter)
    every = select_draws(idata, None)
    if n_draws is None:
        n_draws = min(_most_draws(variables), int(np.prod(every.shape)))
    draws = select_draws(idata, n_draws)
    parts = []
    for variable in variables:
        at_draws = VariableAtDraws(model, variable, draws)
        records = zip(at_draws.records, at_draws.generators(rng), strict=True)
        with at_draws.progress("predictions", enabled=progressbar, n_tasks=3):
            found = [_of_record(record, own) for record, own in records]
        name = variable.name
        part = results_by_row(
            at_draws,
            times_of(at_draws, [one.record.steps for one in found]),
            {
                f"{name}_predicted": ("observable", [one.predicted for one in found]),
                f"{name}_n_effective": ("", [one.health.n_effective for one in found]),
            },
        )
        part[f"{name}_predicted"].attrs = {"filter": repr(variable.filter)}
        observed = [one.record.measured for one in found]
        part = part.merge(_results_by_row(variable, [one.calibration for one in found], observed))
        part = part.merge(by_record(at_draws, [_results_by_record(one) for one in found]))
        parts.append(part)
        healths = [one.health for one in found]
        at_draws.warn_about([one.health for one in healths], [one.seeds for one in healths])
    n_used, n_all = (int(np.prod(one.shape)) for one in (draws, every))
    attrs = {"predictions": PREDICTION_NOTE, "draws": f"{n_used} of {n_all}"}
    for verdict in stored(idata, model, OFF) if filter is None else ():
        warn(verdict, FilterWarning)
    return add_group(idata, "filter_diagnostics", xr.merge(parts), attrs, extend_inferencedata)


def _most_draws(variables: list[StateSpaceVariable]) -> int:
    """How many draws the numbers allow that the rows of the variables need at each."""
    n_numbers = 0
    for variable in variables:
        n, p = variable.system.n, variable.system.p
        n_rows = len(variable.steps.eval(mode="FAST_COMPILE"))
        n_numbers += n_rows * (4 * n + p + p**2)
    return max(_LEAST_DRAWS, int(_MOST_NUMBERS / n_numbers))


class _Found(NamedTuple):
    """What the predictions of a record say."""

    record: RecordAtDraws
    health: TermHealthAtDraws
    predicted: Array
    calibration: Calibration


def _of_record(record: RecordAtDraws, rng: np.random.Generator) -> _Found:
    before = record.states("predicted", record.steps, rng)
    health = _term_health(record, before, rng)
    predicted = simulate_observations(
        record, record.variable.system, before.drawn, record.steps, record.inputs, rng
    )
    laws = laws_of(record, before)
    if laws is None:
        calibration = calibration_by_rank(predicted, record.scored, rng, record.flags)
    else:
        calibration = calibration_of(laws, record.scored, rng, record.flags)
    return _Found(record, health, predicted, calibration)


def _term_health(
    record: RecordAtDraws, before: States, rng: np.random.Generator
) -> TermHealthAtDraws:
    """Effective numbers behind the terms."""
    if record.variable.filter.noisy:
        return record.term_health(rng)
    return TermHealthAtDraws(before.seeds, before.n_effective, before.health)


def _results_by_row(
    variable: StateSpaceVariable, calibrations: list[Calibration], observed: list[Array]
) -> xr.Dataset:
    """PIT values, residuals and innovations of the observations."""
    name, (time, observable) = variable.name, variable.dims
    bis = f"{observable}_bis"
    rows = Calibration(*map(np.concatenate, zip(*calibrations, strict=True)))
    return xr.Dataset(
        {
            f"{name}_pit": (variable.dims, rows.pit),
            f"{name}_residual": (variable.dims, rows.residual),
            f"{name}_clipped": (variable.dims, rows.clipped),
            f"{name}_innovation": (variable.dims, np.concatenate(observed) - rows.mean),
            f"{name}_innovation_cov": ((time, observable, bis), rows.cov),
        },
        coords={bis: list(variable.system.observables)},
    )


def _results_by_record(found: _Found) -> xr.Dataset:
    """What the observations of a record say together: coverage, tests, correlations, failures."""
    record, calibration = found.record, found.calibration
    name, (_, observable), system = (
        record.variable.name, record.variable.dims, record.variable.system
    )  # fmt: skip
    pit, residual = calibration.pit, calibration.residual
    innovation = record.measured - calibration.mean
    z, lags = standardised(innovation, calibration.cov), lags_of(len(innovation))
    smallest = np.fmin.reduce(found.health.n_effective, axis=1, initial=np.inf)
    results = xr.Dataset(
        {
            f"{name}_coverage": (
                ("interval", observable),
                np.array([coverage_of(pit, prob) for prob in PROBS]),
            ),
            f"{name}_uniformity": ((observable,), [uniformity_of(column) for column in pit.T]),
            f"{name}_whiteness": ((observable,), [whiteness_of(column) for column in residual.T]),
            f"{name}_autocorrelation": (("lag", observable), autocorrelation_of(z, lags)),
            f"{name}_failed": np.mean(found.health.health[:, 1] != 0),
            f"{name}_collapsed": np.mean(smallest < COLLAPSED),
        },
        coords={"interval": list(PROBS), "lag": lags, observable: list(system.observables)},
    )
    if not system.n_inputs:
        return results
    # The mean over the draws, where inputs depend on them.
    given = inputs_of_user(system, record.inputs)
    inputs = inputs_before(given.mean(axis=0), record.steps)
    past = np.insert(lags, 0, 0)
    return results.assign(
        {
            f"{name}_input_correlation": (
                ("input_lag", "input", observable),
                input_correlation_of(z, inputs, past),
            )
        }
    ).assign_coords(input_lag=past, input=list(system.inputs))
