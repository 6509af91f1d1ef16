"""`extend`: more rows for a finished sequential run."""

from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from ..compiler.native.compilation import COMPILATION
from ..errors import DataMismatchError, ModelError
from ..filters.checks import check_system_and_filter
from ..parallel.signals import keeps_what_is_there
from ..pymc_model.filter_rows import Record
from ..pymc_model.inspection import given_model
from ..system.censoring import read_flags
from ..system.checks import check_flag, check_random_seed
from ..system.clock import times_of_data
from ..system.given_record import GivenRecord
from ..system.input_columns import (
    columns_of_steps,
    flags_at,
    inputs_of_user,
    resets_at,
    with_resets,
)
from ..system.placement import Earlier
from ..system.record import check_observed, read_record
from ..system.steps import GRID_TOLERANCE, check_steps
from .filter_doubts import kept_from
from .observed_rows import ObservedRows
from .sequential_output import finished
from .stored_run import restored
from .stored_steps import StoredSteps


@keeps_what_is_there
def extend(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    observed: Any,
    steps: Any = None,
    times: Any = None,
    inputs: Any = None,
    events: Any = None,
    censored: Any = None,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
) -> xr.DataTree:
    """Go on with more rows from a finished sequential run: `sample_smc` with ``data="sequential"``.

    The result is bit for bit that of one run over all rows. A row costs one update of the filter of
    each particle; the rows so far are filtered again only where the particles have to be moved.

    Parameters
    ----------
    idata : xarray.DataTree
        The result of `sample_smc` or of `extend`, also read from a file.
    model : pymc.Model, optional
        Its model, with the record of that run or a longer one, which is not looked at; by default
        that of the ``with`` block.
    observed : array_like, shape (J, p) or (J,)
        The new rows. Rows that the run has seen may come before them, with the same values.
    steps, times : array_like, shape (J,)
        When they were observed, exactly one of the two, as in `StateSpace`: steps count from the
        step 0 of the run, and dates from its origin, whatever the record of ``model``. The dates of
        a Series or DataFrame are its times.
    inputs : array_like, optional
        Inputs of all rows, old and new, by step.
    events : DataFrame or mapping of columns, optional
        Events after the last row seen, as in `StateSpace`; by default the later ones of the model.
    censored : array_like, optional
        Which of these values are censored, as in `StateSpace`, of a model with censored data.
    random_seed : int or numpy.random.Generator, optional
        Seed of the rows to come; by default that of the run, which makes it one with them.
    progressbar : bool
        Whether to show the row, after two seconds.

    Returns
    -------
    xarray.DataTree
        As that of `sample_smc`, of all rows. States, forecasts and evidence from its draws need a
        model of all rows, and refuse another one. The filter is not checked again:
        ``attrs["filter_check"]`` keeps that it was found to be off, and drops that there was no
        sign of it in the rows before.

    Raises
    ------
    ModelError
        If the result is not of a sequential run, or no row comes after those that it has seen.
    DataMismatchError
        If the model is another one, or rows or inputs disagree with those seen.

    Warns
    -----
    EvidenceWarning
        As `sample_smc`.
    FilterWarning
        If the filter was found to be off before.

    See Also
    --------
    check_filter : Compare the filter with an unbiased one over all rows.
    run_filter : The same at fixed parameters, with ``state=``.

    Notes
    -----
    The group ``smc_state`` holds the particles with weights and states of their filters: for every
    particle (states + 1) x members x 8 bytes with members, less without.

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
    >>> with pm.Model() as model:
    ...     a = pm.Uniform("a")
    ...     _ = psf.StateSpace("d", system, psf.EKF(), steps=[1, 2, 3], observed=[0.1, 0.9, 1.2])
    ...     idata = psf.sample_smc(50, data="sequential", random_seed=1, progressbar=False)
    ...     longer = psf.extend(idata, observed=[0.7], steps=[4], progressbar=False)
    >>> longer["smc"]["score"].sizes["row"]
    4
    """
    check_flag("progressbar", progressbar)
    progress, request = restored(idata, given_model(model))
    rows = progress.rows
    if times is None and steps is None:
        times = times_of_data(observed)
    record = _longer(rows, _new_rows(rows, observed, steps, times, inputs, events, censored))
    if random_seed is not None:
        entropy = check_random_seed(random_seed).integers(2**63, size=2).tolist()
        request = request._replace(entropy=tuple(entropy))
    progress = progress._replace(rows=rows.with_record(record))
    with COMPILATION:
        return finished(progress, request, kept_from(idata), StoredSteps(), progressbar=progressbar)


def _new_rows(
    rows: ObservedRows,
    observed: Any,
    steps: Any,
    times: Any,
    inputs: Any,
    events: Any,
    censored: Any,
) -> Record:
    """The rows that come after those seen, as a record of their own; the others must agree."""
    system, clock = rows.variable.system, rows.variable.clock
    if steps is None and times is None:
        raise ModelError("observed brings no dates: give steps or times")
    if steps is not None and times is not None:
        raise ModelError("give exactly one of steps and times")
    seen = rows.record.steps if steps is not None else rows.seen_times
    name, given = ("steps", check_steps(steps)) if steps is not None else ("times", times)
    at = given if steps is not None else clock.numbers("times", times)
    values = check_observed(observed, system, len(at))
    tolerance = 0.0 if steps is not None else GRID_TOLERANCE * system.dt
    n_old = int((at <= seen[-1] + tolerance).sum())
    _check_agree(name, given, at[:n_old], values[:n_old], seen, rows.record.observed, tolerance)
    if n_old == len(at):
        raise ModelError(
            f"{name} must go on after the last row seen, at {rows.shown_times[-1]}, got none later"
        )
    ends = [float(rows.seen_times[-1])] if system.is_at_any_times else None
    earlier = Earlier(clock, float(rows.record.t0), [int(rows.record.steps[-1])], ends)
    if events is None and rows.variable.events:
        (events,) = rows.variable.events
    flags = read_flags(censored, system)
    if flags is not None and not system.is_censored:
        raise ModelError(
            "censored must be None where no row of the run so far is censored: run sample_smc over "
            "all rows"
        )
    new = GivenRecord(
        values[n_old:], **{name: given[n_old:]}, inputs=inputs, t0=earlier.t0, events=events,
        censored=None if flags is None else flags[n_old:],
    )  # fmt: skip
    found = read_record(system, new, earlier)
    if found.system.has_instant_steps:
        check_system_and_filter(found.system, rows.variable.filter)
    if found.system.with_instant_steps(False) != system.with_instant_steps(False):
        raise ModelError(
            "times must lie on the grid of steps t0 + k*dt, as those of the run do: round with "
            "psf.nearest_steps, or run sample_smc over all rows"
        )
    return Record(*found.arguments)


def _check_agree(
    name: str, given: Any, at: np.ndarray, values: np.ndarray, seen: np.ndarray,
    known: np.ndarray, tolerance: float,
) -> None:  # fmt: skip
    """Raise unless rows that are not new are among those that were seen."""
    for i, (place, own) in enumerate(zip(at, values, strict=True)):
        j = int(np.abs(seen - place).argmin())
        if abs(seen[j] - place) > tolerance:
            raise DataMismatchError(
                f"{name}[{i}] = {given[i]} lies before the last row seen and is not among the rows "
                "seen: rows must come in order; run sample_smc over all rows"
            )
        if not np.array_equal(own, known[j], equal_nan=True):
            raise DataMismatchError(
                f"observed[{i}] = {own.tolist()} disagrees with the row seen at {given[i]}, "
                f"{known[j].tolist()}: run sample_smc again over the corrected rows"
            )


def _longer(rows: ObservedRows, new: Record) -> Record:
    """The record seen and the new rows behind it."""
    seen, system = rows.record, rows.variable.system
    last = int(seen.steps[-1])
    inputs = new.inputs
    if system.n_input_columns:
        inputs = inputs.copy()
        old, own = (inputs_of_user(system, one[:last]) for one in (seen.inputs, inputs))
        if not np.array_equal(old, own):
            row = int(np.flatnonzero((old != own).any(axis=1))[0])
            raise DataMismatchError(
                f"inputs must have the rows of the run so far, and further ones; row {row} was "
                f"{old[row].tolist()}, got {own[row].tolist()}"
            )
        inputs[:last] = seen.inputs[:last]
        inputs[last] = with_resets(system, inputs[last], resets_at(system, seen.observed[-1]))
        if system.is_censored and (columns := columns_of_steps(system, inputs)) is not None:
            columns[last, -system.p :] = flags_at(system, seen.inputs, [last])  # of inputs: a view
    steps = np.concatenate([seen.steps, new.steps])
    return Record(steps, np.concatenate([seen.observed, new.observed]), inputs, seen.t0)
