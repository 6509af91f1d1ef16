"""Forecasts of states and observations at draws of the posterior."""

from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ..compiler.native.python_call import call_machine_code
from ..errors import ModelError
from ..evaluation.simulate import continuation
from ..pymc_model.inspection import given_model
from ..pymc_model.state_graphs import observed_variables
from ..system.checks import check_random_seed, is_integer
from ..system.steps import steps_of
from .draws import select_draws
from .groups import add_group, join_rows, row_coords, state_dims
from .record import Array, RecordAtDraws
from .variable import VariableAtDraws, select_variables


def forecast(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    n_steps: int | None = None,
    steps: Any = None,
    times: Any = None,
    inputs: Any = None,
    var_name: str | None = None,
    filter: Any = None,
    n_draws: int | None = None,
    random_seed: int | np.random.Generator | None = None,
    extend_inferencedata: bool = True,
    progressbar: bool = True,
) -> xr.DataTree:
    """Predict states and observations after the last observation, at draws of the posterior.

    For each draw, a state at the last observation is drawn and simulated forward with fresh process
    and observation noise. Accumulators sum from one predicted step to the next.

    Parameters
    ----------
    idata, model, var_name, filter, n_draws, random_seed, extend_inferencedata, progressbar
        As in `filtered_states`.
    n_steps : int, optional
        Number of steps after the last observation. Give exactly one of `n_steps`, `steps`, `times`.
    steps : array_like of int, shape (R,), optional
        Steps after the last observation, increasing.
    times : array_like, shape (R,), optional
        Times after the last observation, on the grid ``t0 + k * dt``.
    inputs : array_like, shape (rows, n_inputs), optional
        Inputs from step 0 on, past and future, row k during step k; required if those of the model
        end before the last step. Of a panel also an array for each record, as in `StateSpace`.

    Returns
    -------
    xarray.DataTree
        With the group ``predictions``. For a variable "d": simulated observations ``d`` (chain,
        draw, d_time, observable), and the simulated path ``d_states`` (chain, draw, d_time, state).
        NaN for a draw at which the filter failed. Of a panel the dimension is d_obs, with the
        coordinates ``d_panel`` and ``d_time``: each record is predicted from its own end, at the
        same `n_steps`, `steps` or `times`.

    Raises
    ------
    ModelError
        If draws, model and settings are inconsistent.

    Warns
    -----
    FilterWarning
        If the filter failed, or its particles collapsed, at some draws.

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
    >>> idata = psf.forecast(idata, model, n_steps=3, random_seed=2)
    >>> idata["predictions"]["d"].sizes, idata["predictions"]["d_time"].values
    (Frozen({'chain': 2, 'draw': 200, 'd_time': 3, 'observable': 1}), array([5., 6., 7.]))
    """
    model = given_model(model)
    rng = check_random_seed(random_seed)
    draws = select_draws(idata, n_draws)
    dims = state_dims(observed_variables(model))
    parts = []
    for variable in select_variables(model, var_name, filter):
        name, system, (time, observable) = variable.name, variable.system, variable.dims
        at_draws = VariableAtDraws(model, variable, draws)
        future = [_future_steps(n_steps, steps, times, record) for record in at_draws.records]
        observations = [
            np.concatenate([record.steps, rows])
            for record, rows in zip(at_draws.records, future, strict=True)
        ]
        if inputs is not None:
            at_draws = at_draws.with_inputs(inputs, observations)
        initial, paths, simulated = [], [], []
        with at_draws.progress("states", enabled=progressbar):
            for rows, all_rows, record, own in zip(
                future, observations, at_draws.records, at_draws.generators(rng), strict=True
            ):
                input_rows = record.inputs_until(all_rows)
                initial.append(record.states("filtered", record.steps[-1:], own))
                path, seen = _simulate(record, initial[-1].drawn[:, 0], rows, input_rows, own)
                paths.append(path)
                simulated.append(seen)
        parts.append(
            draws.dataset(
                {
                    name: ((time, observable), join_rows(simulated)),
                    f"{name}_states": ((time, dims[name]), join_rows(paths)),
                },
                {
                    **row_coords(at_draws, future),
                    dims[name]: list(system.states),
                    observable: list(system.observables),
                },
            )
        )
        at_draws.warn_about([one.health for one in initial], [one.seeds for one in initial])
    return add_group(idata, "predictions", xr.merge(parts), {}, extend_inferencedata)


def _future_steps(
    n_steps: int | None, steps: Any, times: Any, record: RecordAtDraws
) -> NDArray[np.int64]:
    """The steps to predict."""
    last = int(record.steps[-1])
    if sum(given is not None for given in (n_steps, steps, times)) != 1:
        raise ModelError("give exactly one of n_steps, steps and times")
    if n_steps is not None:
        if not is_integer(n_steps) or n_steps < 1:
            raise ModelError(f"n_steps must be an integer of at least 1, got {n_steps!r}")
        return np.arange(last + 1, last + 1 + n_steps)
    future = steps_of(steps, times, record.variable.system.dt, record.t0)
    if future[0] <= last:
        raise ModelError(
            f"{record.prefix}steps must be after the last observation, at step {last}, got "
            f"{future[0]}: for earlier states use filtered_states or smoothed_states"
        )
    return future


def _simulate(
    record: RecordAtDraws,
    initial: Array,
    future: NDArray[np.int64],
    rows: Array,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Simulate states (draws, R, n) and observations (draws, R, p) from states (draws, n)."""
    system, t0, first = record.variable.system, record.t0, int(record.steps[-1])
    theta, simulate = record.theta, continuation(system).function
    paths = np.full((len(initial), future.size, system.n), np.nan)
    observed = np.full((len(initial), future.size, system.p), np.nan)
    for i in np.flatnonzero(np.isfinite(initial).all(axis=1)):
        inputs = rows[i if len(rows) > 1 else 0]
        paths[i], observed[i] = call_machine_code(
            simulate, rng, theta[i], initial[i], first, future, inputs, t0
        )
    return paths, observed
