"""Free runs: simulations at draws of the posterior that see no observation, and their errors."""

import warnings
from collections.abc import Sequence
from functools import partial
from itertools import repeat
from threading import Event
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ..errors import FilterWarning, ModelError, warn
from ..evaluation.simulate import simulator
from ..parallel.cpu_affinity import available_cores
from ..parallel.threads import run_in_threads
from ..pymc_model.checked_model import checked_model
from ..system.checks import check_flag, check_random_seed, shortened
from ..system.given_record import events_of_records, inputs_with_times
from ..system.input_columns import check_inputs, only_seen
from ..system.own_units import in_own_units
from ..system.placement import Placement, Timing, place_by
from ..system.record import check_observed
from ..system.timed_inputs import check_inputs_at
from .draws import SAMPLE_DIMS, select_draws
from .groups import add_group, by_record, results_by_row
from .record import Array, RecordAtDraws, simulate_observations
from .variable import VariableAtDraws, select_variables


def free_run(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    inputs: Any = None,
    input_times: Any = None,
    inputs_at: str = "hold",
    events: Any = None,
    steps: Any = None,
    times: Any = None,
    observed: Any = None,
    noise: bool = False,
    var_name: str | None = None,
    new_data: bool = False,
    n_draws: int | None = None,
    random_seed: int | np.random.Generator | None = None,
    extend_inferencedata: bool = True,
    progressbar: bool = True,
) -> xr.DataTree:
    """Simulate from step 0 at draws of the posterior, without looking at observations.

    The test of a model by its simulation: parameters are those of the draws, and nothing pulls the
    states back to a record. New inputs, steps and lengths compile nothing anew.

    Parameters
    ----------
    idata, model, var_name, new_data, n_draws, random_seed, extend_inferencedata, progressbar
        As in `filtered_states`.
    inputs : array_like, shape (rows, n_inputs), optional
        Row k holds during step k; by default those of the model. Of a panel also an array for
        each record, as in `StateSpace`.
    steps : array_like of int, shape (R,), optional
        When to predict an observation, from step 0 of the simulation on; by default the steps of
        the variable's record. Accumulators sum from one of them to the next, as in the data there.
    times : array_like, shape (R,), optional
        The same as times, numbers or dates as those of the model. Give at most one of both.
    input_times, inputs_at
        Times of the rows of `inputs`, and what inputs are between them, as in `StateSpace`.
    events : DataFrame or mapping of columns, optional
        Events, as in `StateSpace`; by default those of the model.
    observed : array_like, shape (R, p) or (R,), optional
        Measurements at these steps, to compare the predictions with; NaN where missing. By default
        the record of the model from ``score_from`` on, if the run has its inputs, events and steps,
        else none. A panel is compared with its own data alone.
    noise : bool
        Whether the initial state, process noise and measurement noise are drawn. By default none
        is: a run starts at the initial mean, and its observations are those of `simulate` with
        ``noise=False``.

    Returns
    -------
    xarray.DataTree
        With the group ``free_run``. For a variable "d": observations ``d`` (chain, draw, d_time,
        observable) and states ``d_states`` (chain, draw, d_time, state); NaN for a draw whose run
        leaves the finite numbers. With measurements, over the times where they are not missing:

        * ``d_rmse`` (observable): root-mean-square error of the mean of ``d`` over all draws.
        * ``d_relative_error`` (observable): the same divided by the standard deviation of the
          measurements; 1 is the error of a constant.
        * ``d_rmse_of_draws`` (chain, draw, observable): root-mean-square error of ``d`` at each
          draw.
        * ``d_coverage`` (interval, observable): the fraction of them inside the central
          intervals of 50 % and 90 % of the predicted measurements, at each time over all draws.
          These have measurement noise, also where ``d`` has none.

        Of a panel the dimension of the rows is d_obs, with the coordinates ``d_panel`` and
        ``d_time``, and each error has the dimension d_record.

    Raises
    ------
    ModelError
        If draws, model and settings are inconsistent.
    DataMismatchError
        If the draws are those of another model or, unless ``new_data``, of other data.

    Warns
    -----
    FilterWarning
        If the simulation leaves the finite numbers at some draws.

    See Also
    --------
    forecast : Predictions from the state at the end of the record.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> tank = psf.StateSpaceModel(
    ...     transition=lambda x, q, u, a: [a * x[0] + u[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.5]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ...     inputs=["flow"],
    ... )
    >>> with pm.Model() as model:
    ...     a = pm.Uniform("a", 0, 1)
    ...     d = psf.StateSpace(
    ...         "d", tank, psf.EKF(), steps=[1, 2, 3], inputs=[1.0, 0.0, 2.0],
    ...         observed=[1.1, 0.7, 2.5],
    ...     )
    ...     idata = psf.sample_dram(200, tune=200, chains=2, random_seed=1, progressbar=False)
    >>> idata = psf.free_run(
    ...     idata, model, inputs=[0.0, 3.0], steps=[1, 2], observed=[0.1, 2.8], random_seed=2
    ... )
    >>> idata["free_run"]["d"].sizes, idata["free_run"]["d_coverage"].sizes
    (Frozen({'chain': 2, 'draw': 200, 'd_time': 2, 'observable': 1}),
     Frozen({'interval': 2, 'observable': 1}))
    """
    model = checked_model(model, idata, any_filter=True, new_data=new_data)
    with_noise = check_flag("noise", noise)
    rng = check_random_seed(random_seed)
    draws = select_draws(idata, n_draws)
    variables = select_variables(model, var_name)
    if panels := [v.name for v in variables if v.is_panel and observed is not None]:
        raise ModelError(
            f"observed must be None for a panel such as {panels[0]!r}: each record is compared with"
            " its own data"
        )
    if observed is not None and len(variables) > 1:
        raise ModelError(
            "observed must be that of one variable: give var_name, one of "
            f"{[variable.name for variable in variables]}"
        )
    is_elsewhere = steps is not None or times is not None
    is_own_run = inputs is None and events is None and not is_elsewhere
    is_compared = observed is not None or is_own_run
    parts = []
    for variable in variables:
        at_draws = VariableAtDraws(model, variable, draws)
        placed = _placed(at_draws, steps, times, inputs, input_times, inputs_at, events)
        name, (time, observable) = variable.name, variable.dims
        names: dict[str, Any] = {observable: list(variable.system.observables)}
        paths, seen, errors = [], [], []
        with at_draws.progress("free runs", enabled=progressbar):
            for one, record, own in zip(
                placed, at_draws.records, at_draws.generators(rng), strict=True
            ):
                (axis,), system = one.axes, one.system
                measured = _measured(record, observed, axis.steps) if is_compared else None
                data = measured if is_elsewhere else record.observed
                rows = _input_rows(record, one, data)
                path, values = _simulate(at_draws, record, one, rows, with_noise, own)
                paths.append(path)
                seen.append(values)
                if measured is not None:
                    noisy = values
                    if not with_noise:
                        noisy = simulate_observations(record, system, path, axis.steps, rows, own)
                    predicted = draws.dataset({name: ((time, observable), values)}, names)[name]
                    errors.append(prediction_errors(predicted, noisy, measured))
        _warn_of_failed_runs(name, paths)
        part = results_by_row(
            at_draws,
            [one.axes[0].times(one.axes[0].steps) for one in placed],
            {
                name: ("observable", seen),
                f"{name}_states": ("state", [in_own_units(variable.system, one) for one in paths]),
            },
        )
        if errors:
            part = part.merge(by_record(at_draws, errors))
        parts.append(part)
    attrs = {"noise": int(with_noise)}  # netCDF has no truth values
    return add_group(idata, "free_run", xr.merge(parts), attrs, extend_inferencedata)


def _placed(
    at_draws: VariableAtDraws,
    steps: Any,
    times: Any,
    inputs: Any,
    input_times: Any,
    inputs_at: Any,
    events: Any,
) -> list[Placement]:
    """Where each record runs, by default that of the data; its inputs are None if the model's."""
    variable, records = at_draws.variable, at_draws.records
    if steps is not None and times is not None:
        raise ModelError("give at most one of steps and times, got both")
    check_inputs_at(inputs_at)
    is_elsewhere = steps is not None or times is not None
    if inputs is None and is_elsewhere and variable.timed:
        inputs_at = variable.timed[0].rule
    own_inputs, own_times = _inputs_of_records(at_draws, inputs, input_times, is_elsewhere)
    own_events: Sequence[Any] = variable.events or [None] * len(records)
    if events is not None:
        own_events = events_of_records(events, [record.label for record in records])
    found = []
    for record, rows, row_times, table in zip(
        records, own_inputs, own_times or [None] * len(records), own_events, strict=True
    ):
        system, at = variable.system, steps
        if steps is None and times is None:
            if row_times is None and events is None:
                found.append(Placement(system, variable.clock, [record.axis], [rows]))
                continue
            if system.is_at_any_times:
                times = record.shown(record.axis.times(record.steps))
            else:
                at = record.steps
        elif steps is not None and system.is_at_any_times:
            raise ModelError(
                f"{record.prefix}steps must be None for a record at times off the grid, got "
                f"{shortened(steps)}: give times"
            )
        timing = Timing(
            None if at is None else [at], None if at is not None else [times], record.t0, None,
            [rows], None if row_times is None else [row_times], inputs_at, [table],
        )  # fmt: skip
        one = place_by(variable.clock, record.t0, system, timing, [record.number])
        if one.inputs[0] is None and system.n_inputs and one.system.is_at_any_times:
            raise ModelError(
                f"{record.prefix}inputs must be given, with input_times, at these times, whose "
                "steps are not those of the model's inputs, got None"
            )
        found.append(one)
    return found


def _inputs_of_records(
    at_draws: VariableAtDraws, inputs: Any, input_times: Any, is_elsewhere: bool
) -> tuple[list[Any], list[Any] | None]:
    """The inputs of each record and their times; None if they are by step.

    The steps between times other than the model's are others, and so are the rows of its inputs.
    """
    variable, records = at_draws.variable, at_draws.records
    if inputs is None and is_elsewhere and variable.timed:
        pairs = list(zip(records, variable.timed, strict=True))
        return [one.values for _, one in pairs], [r.shown(one.times) for r, one in pairs]
    labels = [record.label for record in records]
    return inputs_with_times(inputs, input_times, labels, variable.clock)


def _measured(record: RecordAtDraws, observed: Any, steps: NDArray[np.int64]) -> Array:
    """The measurements (R, p) to compare with: those given, else those of the model."""
    if observed is None:
        return record.measured
    return check_observed(observed, record.variable.system, steps.size)


def _input_rows(record: RecordAtDraws, placed: Placement, data: Array | None) -> Array:
    """The input rows (draws or 1, rows, columns) of a run: those given, else the model's.

    Accumulators are set to zero where the ``data`` (R, p) have them, in every row without data.
    """
    (axis,), (inputs,) = placed.axes, placed.inputs
    if inputs is None:
        rows = record.inputs_until(axis)
    else:
        rows = check_inputs(inputs, placed.system, axis)[None]
    rows = only_seen(placed.system, rows, axis.steps, data)
    # A copy: the simulator would be compiled again for arrays of another layout.
    return np.array(rows, order="C")


def _simulate(
    at_draws: VariableAtDraws,
    record: RecordAtDraws,
    placed: Placement,
    rows: Array,
    noise: bool,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """States (draws, R, n) and observations (draws, R, p), each chain in a thread of its own.

    ``rows`` are the inputs, by draw or one. NaN for a draw with a number that is not finite.
    """
    t0, theta, system, steps = record.t0, record.theta, placed.system, placed.axes[0].steps
    run, n_chains = simulator(system, noise).function, at_draws.draws.shape[0]
    paths = np.empty((len(theta), steps.size, system.n))
    seen = np.empty((len(theta), steps.size, system.p))
    stopped, n_done = Event(), np.zeros(n_chains, dtype=np.int64)

    def simulate_chain(number: int, chain: NDArray[np.int64], seed: np.int64) -> None:
        own_rng = np.random.default_rng(seed)
        for i in chain:
            if stopped.is_set():
                return
            inputs = rows[i if len(rows) > 1 else 0]
            states, seen[i] = run(own_rng, theta[i], steps, inputs, t0)
            paths[i] = states[steps]
            n_done[number] += 1

    chains = np.split(np.arange(len(theta)), n_chains)
    seeds = rng.integers(np.iinfo(np.int64).max, size=n_chains)
    run_in_threads(
        list(map(partial, repeat(simulate_chain), range(n_chains), chains, seeds)),
        min(available_cores(), n_chains),
        n_done=lambda: int(n_done.sum()),
        stop=stopped.set,
        on_progress=at_draws.on_progress,
    )
    failed = ~(np.isfinite(paths).all(axis=(1, 2)) & np.isfinite(seen).all(axis=(1, 2)))
    paths[failed] = seen[failed] = np.nan
    return paths, seen


def _warn_of_failed_runs(name: str, paths: Sequence[Array]) -> None:
    """Warn of the runs (draws, R, n) of every record that have NaN."""
    failed = np.concatenate([np.isnan(path).any(axis=(1, 2)) for path in paths])
    if failed.any():
        runs = "draws" if len(paths) == 1 else "draws and records"
        warn(
            f"the free run of {name!r} leaves the finite numbers at {failed.sum()} of "
            f"{failed.size} {runs}, where the model is unstable: their predictions are NaN, and no "
            "error or coverage counts them",
            FilterWarning,
        )


PROBABILITIES = np.array([0.5, 0.9])  # of the central intervals


def prediction_errors(predicted: xr.DataArray, measured: Array, observed: Array) -> xr.Dataset:
    """Errors of predictions (chain, draw, time, observable) of a record (R, p).

    ``measured`` (draws, R, p) are predictions with measurement noise. Missing data and NaN draws
    are left out.
    """
    name, (time, observable) = predicted.name, map(str, predicted.dims[-2:])
    record = xr.DataArray(observed, dims=(time, observable))
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)  # means of nothing are NaN
        rmse = _rmse(predicted.mean(SAMPLE_DIMS), record, time)
        return xr.Dataset(
            {
                f"{name}_rmse": rmse,
                f"{name}_relative_error": rmse / record.std(time),
                f"{name}_rmse_of_draws": _rmse(predicted, record, time),
                f"{name}_coverage": (("interval", observable), _coverage(measured, observed)),
            },
            coords={"interval": PROBABILITIES.tolist()},
        )


def _rmse(predicted: xr.DataArray, record: xr.DataArray, time: str) -> xr.DataArray:
    return ((predicted - record) ** 2).mean(time) ** 0.5


def _coverage(measured: Array, observed: Array) -> Array:
    """Fraction (2, p) of the record in the central intervals of each time."""
    known, drawn = ~np.isnan(observed), measured[np.isfinite(measured).all(axis=(1, 2))]
    if not len(drawn):
        return np.full((len(PROBABILITIES), observed.shape[1]), np.nan)
    low, high = (np.quantile(drawn, (1 + sign * PROBABILITIES) / 2, axis=0) for sign in (-1, 1))
    inside = known & (low <= observed) & (observed <= high)
    return inside.sum(axis=1) / known.sum(axis=0)
