"""The rows of a panel from a table in long format: one row for each observation."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from ..errors import ModelError
from .checks import shortened
from .clock import are_dates
from .panel_records import records_of
from .signature import TIME
from .steps import nearest_steps


def panel_from(
    frame: pd.DataFrame,
    *,
    record: str,
    time: str,
    values: str | Sequence[str],
    dt: float | None = None,
    t0: Any = 0.0,
    unit: Any = None,
    censored: str | Sequence[str] | None = None,
    events: pd.DataFrame | None = None,
) -> dict[str, Any]:
    """Arguments of a panel from a table in long format, one row for each observation.

    Parameters
    ----------
    frame : pandas.DataFrame
        Its rows may be in any order.
    record : str
        The column of labels of records, integers or texts.
    time : str
        The column of times: numbers in the unit of the system's ``dt``, or dates.
    values : str or sequence of str
        The column of each observable; NaN where missing. Several have the names of the system's
        observables, in any order; a single column may have any name.
    dt : float, optional
        Length of a step of the system, if times are to be rounded to the nearest steps. By default
        they are left as they are, which takes a system with an integrator.
    t0, unit
        Time of step 0, and the duration of one unit of model time, for dates, see `StateSpace`. By
        default a record with dates starts at its first row.
    censored : str or sequence of str, optional
        The column of the flags of each column of ``values``, see `StateSpace`.
    events : pandas.DataFrame, optional
        The events of all records, a row for each: the columns ``record`` and ``time``, and those of
        the events of the system.

    Returns
    -------
    dict
        The arguments ``panel``, ``steps`` or ``times``, and ``observed`` (J, p) of `StateSpace`,
        `log_likelihood` and `run_filter`, and ``t0``, ``unit``, ``censored`` and ``events``.
        Records are in the order of their first rows, the rows of each by time.

    Raises
    ------
    ModelError
        If a column is missing, a label or a time is none, two times of a record fall on one step,
        or a time lies before ``t0``.

    See Also
    --------
    nearest_steps : The steps of a single record.

    Examples
    --------
    >>> import pandas as pd
    >>> import pymc_statespace_filters as psf
    >>> frame = pd.DataFrame({
    ...     "patient": ["A", "B", "A", "B"],
    ...     "hour": [2.0, 1.0, 0.0, 2.6],
    ...     "level": [0.8, 0.7, 1.1, None],
    ... })
    >>> panel = psf.panel_from(frame, record="patient", time="hour", values="level", dt=0.5)
    >>> panel["panel"], panel["steps"]
    (array(['A', 'A', 'B', 'B'], dtype=object), array([0, 4, 2, 5]))
    >>> panel["observed"].ravel()
    array([1.1, 0.8, 0.7, nan])
    """
    if not isinstance(frame, pd.DataFrame):
        raise ModelError(f"frame must be a pandas.DataFrame, got {type(frame).__name__}")
    columns = [values] if isinstance(values, str) else list(values)
    flags = [censored] if isinstance(censored, str) else list(censored or columns)
    if len(flags) != len(columns):
        raise ModelError(f"censored must name a column for each of {columns}, got {flags}")
    roles = (("record", [record]), ("time", [time]), ("values", columns), ("censored", flags))
    for argument, names in roles:
        if missing := [name for name in names if name not in frame.columns]:
            raise ModelError(
                f"{argument} must name columns of frame, {list(frame.columns)}, got {missing}"
            )
    if not len(frame) or not columns:
        raise ModelError("frame must have at least one row and one column of values, got none")
    numbers = pd.factorize(frame[record])[0]
    if (numbers < 0).any():
        row = frame.index.tolist()[int(np.argmax(numbers < 0))]
        raise ModelError(f"every row of frame must have a record, got none in row {row!r}")
    observed, has_dates = _floats(frame, columns), are_dates(frame[time])
    if not has_dates and not pd.api.types.is_numeric_dtype(frame[time]):
        raise ModelError(
            f"column {time!r} of frame must hold numbers or dates (read text with pd.to_datetime), "
            f"got {frame[time].dtype}"
        )
    times = frame[time] if has_dates else pd.Series(_floats(frame, [time])[:, 0])
    order = np.lexsort([times.to_numpy(), numbers])
    labels, tables = np.asarray(frame[record])[order], {"observed": observed[order]}
    if censored is not None:
        tables["censored"] = _floats(frame, flags)[order]
    named: dict[str, Any] = dict(tables)
    if len(columns) > 1:
        named = {name: pd.DataFrame(own, columns=columns) for name, own in tables.items()}
    records = records_of(labels)
    if events is not None:
        named["events"] = _events(events, record, time, records.labels, rounds=dt is not None)
    parts = [
        _times(frame, order[rows], times.iloc[order[rows]], label)
        for label, rows in zip(records.labels, records.slices(), strict=True)
    ]
    if dt is None:
        at = times.iloc[order]
        when = {"times": pd.DatetimeIndex(at) if has_dates else at.to_numpy()}
        return {"panel": labels, **when, **named, "t0": t0, "unit": unit}
    steps = [
        _steps(frame, order[rows], own, label, dt, t0, unit)
        for label, rows, own in zip(records.labels, records.slices(), parts, strict=True)
    ]
    return {
        "panel": labels,
        "steps": np.concatenate(steps),
        **named,
        "t0": 0.0 if are_dates(t0) else t0,
    }


def _events(
    events: pd.DataFrame, record: str, time: str, labels: Sequence[Any], *, rounds: bool
) -> dict[Any, pd.DataFrame]:
    """The table of events of each record."""
    if not isinstance(events, pd.DataFrame) or not {record, time} <= set(events.columns):
        raise ModelError(
            f"events must be a pandas.DataFrame with the columns {[record, time]} and the numbers "
            f"of events, got {shortened(events)}"
        )
    if rounds and are_dates(events[time]):
        raise ModelError("events with dates need times with dates: leave out dt")
    if (unknown := ~events[record].isin(labels)).any():
        row = events.index.tolist()[int(np.argmax(unknown))]
        raise ModelError(
            f"events must be of records of frame, got {events[record][row]!r} in row {row!r}"
        )
    by_time = events.sort_values(time, kind="stable").rename(columns={time: TIME})
    return {label: by_time[by_time[record] == label].drop(columns=record) for label in labels}


def _times(frame: pd.DataFrame, rows: np.ndarray, times: pd.Series, label: Any) -> pd.Series:
    if times.isna().any():
        row = frame.index.tolist()[rows[int(np.argmax(times.isna()))]]
        raise ModelError(
            f"record {label!r} of frame must have a time in every row, got none in row {row!r}"
        )
    return times


def _steps(
    frame: pd.DataFrame,
    rows: np.ndarray,
    times: pd.Series,
    label: Any,
    dt: float,
    t0: Any,
    unit: Any,
) -> np.ndarray:
    try:
        return nearest_steps(times, dt, t0=t0, unit=unit)
    except ModelError as error:
        first = shortened(frame.index[rows].tolist())
        raise ModelError(f"record {label!r}, rows {first} of frame: {error}") from None


def _floats(frame: pd.DataFrame, columns: Sequence[str]) -> np.ndarray:
    for name in columns:
        if not pd.api.types.is_numeric_dtype(frame[name]):
            raise ModelError(f"column {name!r} of frame must hold numbers, got {frame[name].dtype}")
    return frame[list(columns)].to_numpy(dtype="float64", na_value=np.nan)
