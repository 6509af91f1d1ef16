"""Forecasts of states and observations at draws of the posterior."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ..compiler.native.python_call import call_machine_code
from ..errors import ModelError
from ..evaluation.simulate import continuation
from ..pymc_model.checked_model import checked_model
from ..pymc_model.in_step import shared_by_ranks
from ..system.checks import check_random_seed, is_integer
from ..system.events import Events, read_events, with_events
from ..system.given_record import events_of_records, inputs_with_times, own_inputs
from ..system.input_columns import (
    inputs_of_other_shape,
    inputs_of_user,
    n_rows_of_user,
    only_seen,
)
from ..system.labels import table_of
from ..system.model import StateSpaceModel
from ..system.own_units import in_own_units
from ..system.placement import check_takes
from ..system.steps import GRID_TOLERANCE, check_steps
from ..system.time_axis import (
    NO_EVENTS,
    TimeAxis,
    TimesBetween,
    axis_of,
    check_increasing,
    is_grid,
)
from ..system.timed_inputs import check_inputs_at, timed_inputs
from .draws import select_draws
from .groups import add_group, results_by_row
from .record import Array, RecordAtDraws
from .variable import VariableAtDraws, select_variables


@shared_by_ranks
def forecast(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    n_steps: int | None = None,
    steps: Any = None,
    times: Any = None,
    inputs: Any = None,
    input_times: Any = None,
    inputs_at: str = "hold",
    events: Any = None,
    var_name: str | None = None,
    filter: Any = None,
    new_data: bool = False,
    n_draws: int | None = None,
    random_seed: int | np.random.Generator | None = None,
    extend_inferencedata: bool = True,
    progressbar: bool = True,
    comm: Any = None,
) -> xr.DataTree:
    """Predict states and observations after the last observation, at draws of the posterior.

    For each draw, a state at the last observation is drawn and simulated forward with fresh process
    and observation noise. Accumulators go on from where they were last seen, and from one predicted
    step to the next.

    Parameters
    ----------
    idata, model, var_name, filter, new_data, n_draws, random_seed
        As in `filtered_states`.
    extend_inferencedata, progressbar, comm
        As in `filtered_states`.
    n_steps : int, optional
        Number of steps after the last observation. Give exactly one of `n_steps`, `steps`, `times`.
    steps : array_like of int, shape (R,), optional
        Steps after the last observation, increasing.
    times : array_like, shape (R,), optional
        Times after the last observation, numbers or dates as those of the model.
    inputs : array_like, shape (rows, n_inputs), optional
        Inputs from step 0 on, past and future, row k during step k; or the future ones alone, a row
        for each step after the last observation, which follow those of the model. Required if
        those of the model end before the last step. Of a panel also an array for each record, as
        in `StateSpace`.
    input_times, inputs_at
        Times of the rows of `inputs`, and what inputs are between them, as in `StateSpace`. Inputs
        of the model with times of their own go on with their last value where no others are given,
        and hold up to the first time of others.
    events : DataFrame or mapping of columns, optional
        Events after the last observation, as in `StateSpace`; by default the later ones of the
        model. One at its time, and not before it, replaces that of the model. Earlier ones are not
        looked at.

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
    DataMismatchError
        If the draws are those of another model or, unless ``new_data``, of other data.

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
    model = checked_model(model, idata, any_filter=filter is not None, new_data=new_data)
    rng = check_random_seed(random_seed)
    draws = select_draws(idata, n_draws)
    parts = []
    for variable in select_variables(model, var_name, filter):
        name, system = variable.name, variable.system
        at_draws = VariableAtDraws(model, variable, draws)
        timed = _timed_inputs(at_draws, inputs, input_times, inputs_at)
        axes = [
            _future_axis(n_steps, steps, times, record, changes, own)
            for record, (_, changes), own in zip(
                at_draws.records, timed, _events(at_draws, events), strict=True
            )
        ]
        if timed[0][0] is not None:
            pairs = zip(timed, axes, at_draws.records, strict=True)
            inputs = [one.rows(axis, variable.clock, r.number) for (one, _), axis, r in pairs]
            inputs = inputs if variable.is_panel else inputs[0]
        elif inputs is not None:
            inputs = _from_step_0(inputs, at_draws, axes)
        future = [axis.steps for axis in axes]
        axes = [
            axis._replace(steps=np.concatenate([record.steps, axis.steps]))
            for record, axis in zip(at_draws.records, axes, strict=True)
        ]
        if inputs is not None:
            at_draws = at_draws.with_inputs(inputs, axes)
        initial, paths, simulated = [], [], []
        with at_draws.progress("states", enabled=progressbar):
            for rows, axis, record, own in zip(
                future, axes, at_draws.records, at_draws.generators(rng), strict=True
            ):
                input_rows = record.inputs_until(axis)
                input_rows = only_seen(system, input_rows, record.steps, record.observed)
                initial.append(record.states("filtered", record.steps[-1:], own))
                ahead = system if axis.starts is None else system.at_any_times
                start = initial[-1].drawn[:, 0]
                path, seen = _simulate(record, ahead, start, rows, input_rows, own)
                paths.append(path)
                simulated.append(seen)
        parts.append(
            results_by_row(
                at_draws,
                [axis.times(rows) for axis, rows in zip(axes, future, strict=True)],
                {
                    name: ("observable", simulated),
                    f"{name}_states": ("state", [in_own_units(system, path) for path in paths]),
                },
            )
        )
        at_draws.warn_about([one.health for one in initial], [one.seeds for one in initial])
    return add_group(idata, "predictions", xr.merge(parts), {}, extend_inferencedata)


def _timed_inputs(
    at_draws: VariableAtDraws, inputs: Any, input_times: Any, inputs_at: Any
) -> list[tuple[Any, Array]]:
    """The inputs of each record if they have times of their own, and when they change."""
    check_inputs_at(inputs_at)
    records, variable = at_draws.records, at_draws.variable
    if inputs is None and input_times is None and variable.timed:
        held = [one.held_on() for one in variable.timed]
        return [(one, one.changes()) for one in held]
    labels = [record.label for record in records]
    own_inputs, own_times = inputs_with_times(inputs, input_times, labels, variable.clock)
    if own_times is None:
        return [(None, np.empty(0))] * len(records)
    system, clock = variable.system, variable.clock
    found = [
        timed_inputs(own, times, inputs_at, system, clock, record.number)
        for own, times, record in zip(own_inputs, own_times, records, strict=True)
    ]
    if variable.timed:
        found = [
            earlier.followed_by(one) if one.times[0] > record.t0 else one
            for earlier, one, record in zip(variable.timed, found, records, strict=True)
        ]
    return [(one, one.changes()) for one in found]


def _events(at_draws: VariableAtDraws, events: Any) -> list[Events | None]:
    """The events of each record, past and future."""
    variable, records = at_draws.variable, at_draws.records
    of_model: list[Events | None] = [*variable.events] or [None] * len(records)
    if events is None:
        return of_model
    found = []
    labels = [record.label for record in records]
    tables = events_of_records(events, labels)
    for earlier, table, record in zip(of_model, tables, records, strict=True):
        system, clock = variable.system, variable.clock
        later = read_events(table, system, clock, record.t0, record.number)
        end = float(record.axis.times(record.steps[-1]))
        tolerance = GRID_TOLERANCE * system.dt
        found.append(earlier and later and earlier.followed_by(later, end, tolerance))
    return found


def _from_step_0(inputs: Any, at_draws: VariableAtDraws, axes: Sequence[TimeAxis]) -> Any:
    """The inputs with those of the model before them where they are future ones alone."""
    records, is_panel = at_draws.records, at_draws.variable.is_panel
    own = own_inputs(inputs, [record.label for record in records]) if is_panel else None
    parts = [inputs] * len(records) if own is None else own
    whole = [_after_past(*each) for each in zip(parts, records, axes, strict=True)]
    if all(one is part for one, part in zip(whole, parts, strict=True)):
        return inputs
    return whole if is_panel else whole[0]


def _after_past(given: Any, record: RecordAtDraws, axis: TimeAxis) -> Any:
    """The inputs of a record, from step 0 on if they have a row for each step to predict."""
    system = record.variable.system
    past = inputs_of_user(system, record.inputs)
    n_past, n_rows = n_rows_of_user(system, record.steps), n_rows_of_user(system, axis.steps)
    is_future = n_past > 0 and np.shape(given)[:1] == (n_rows - n_past,)
    if not is_future or len(past) > 1 or axis.starts is not None:
        return given
    ahead = table_of("inputs", given, system.inputs, "inputs")
    if ahead.shape[1:] != (system.n_inputs,):
        raise inputs_of_other_shape(system, ahead.shape)
    return np.concatenate([past[0, :n_past], ahead])


def _future_axis(
    n_steps: int | None,
    steps: Any,
    times: Any,
    record: RecordAtDraws,
    changes: Array,
    events: Events | None,
) -> TimeAxis:
    """The axis of a record and its future, with the steps to predict."""
    past, system, clock = record.axis, record.variable.system, record.variable.clock
    last, end = int(record.steps[-1]), float(past.times(record.steps[-1]))
    if sum(given is not None for given in (n_steps, steps, times)) != 1:
        raise ModelError("give exactly one of n_steps, steps and times")
    if n_steps is not None:
        if not is_integer(n_steps) or n_steps < 1:
            raise ModelError(f"n_steps must be an integer of at least 1, got {n_steps!r}")
        steps = np.arange(last + 1, last + 1 + n_steps)
    if steps is not None:
        steps = check_steps(steps)
        numbers = end + system.dt * (steps - last)
    else:
        numbers = clock.numbers("times", times, record.number)
    if numbers.size == 0 or numbers[0] <= end + GRID_TOLERANCE * system.dt:
        name, at, got = "steps", f"step {last}", [] if steps is None else steps
        if steps is None:
            name, at, got = "times", str(record.shown(end)), record.shown(numbers)
        raise ModelError(
            f"{record.prefix}{name} must be after the last observation, at {at}, got "
            f"{got[0] if len(got) else 'none'}: for earlier states use filtered_states or "
            "smoothed_states"
        )
    check_increasing("times", numbers, record.shown)
    changes = changes[(changes > end) & (changes < numbers[-1])]
    when = NO_EVENTS if events is None else events.at
    if system.is_at_any_times:
        return with_events(past.followed_by(numbers, changes, when), events, clock, record.number)
    given = TimesBetween(None, numbers, record.t0, changes, when)
    if is_grid([given], system.dt):
        on_grid = axis_of(given, system.dt, on_grid=True)
        return with_events(on_grid, events, clock, record.number)
    check_takes(system, given, clock, record.number)
    if system.n_inputs:
        raise ModelError(
            f"{record.prefix}times to predict, and changes of the inputs, must lie on the grid of "
            f"steps of a model with inputs whose record does, t0 = {record.t0:g} and dt = "
            f"{system.dt:g}, got times {record.shown(numbers)}"
        )
    return with_events(past.followed_by(numbers, changes, when), events, clock, record.number)


def _simulate(
    record: RecordAtDraws,
    system: StateSpaceModel,
    initial: Array,
    future: NDArray[np.int64],
    rows: Array,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Simulate states (draws, R, n) and observations (draws, R, p) from states (draws, n)."""
    t0, first = record.t0, int(record.steps[-1])
    theta, simulate = record.theta, continuation(system).function
    paths = np.full((len(initial), future.size, system.n), np.nan)
    observed = np.full((len(initial), future.size, system.p), np.nan)
    for i in np.flatnonzero(np.isfinite(initial).all(axis=1)):
        inputs = rows[i if len(rows) > 1 else 0]
        paths[i], observed[i] = call_machine_code(
            simulate, rng, theta[i], initial[i], first, future, inputs, t0
        )
    return paths, observed
