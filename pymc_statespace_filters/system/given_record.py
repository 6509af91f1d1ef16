"""A record, or the records of a panel, as a user gives them: the arguments are read once, here."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from pytensor.graph.basic import Variable

from ..errors import ModelError
from .checks import shortened
from .clock import Clock, are_dates, date_index, times_of_data
from .model import StateSpaceModel
from .panel_records import Records
from .placement import Earlier, Placement, Timing, place
from .signature import TIME
from .timed_inputs import times_of_inputs


@dataclass(frozen=True, eq=False)  # arrays are not hashable
class GivenRecord:
    """The arguments of `StateSpace` that describe data; ``observed`` is None in a simulation."""

    observed: Any = None
    panel: Any = None
    steps: Any = None
    times: Any = None
    inputs: Any = None
    t0: Any = 0.0
    unit: Any = None
    input_times: Any = None
    inputs_at: Any = "hold"
    events: Any = None
    censored: Any = None

    def current(self) -> "GivenRecord":
        """The same with the current numbers of symbolic steps and labels."""
        steps, panel = (
            value.eval() if isinstance(value, Variable) else value
            for value in (self.steps, self.panel)
        )
        return replace(self, steps=steps, panel=panel)

    def check_numbers(self) -> None:
        """Raise if a part is a symbol."""
        for name in ("observed", "panel", "steps", "inputs"):
            value = getattr(self, name)
            for part in value if isinstance(value, list | tuple) else [value]:
                if isinstance(part, Variable):
                    raise ModelError(f"{name} must be numbers, got a symbol")

    def placed(
        self, system: StateSpaceModel, records: Records, earlier: Earlier | None = None
    ) -> Placement:
        """Where the observations lie, and the inputs, of each record."""
        if isinstance(self.times, Variable):
            raise ModelError("times must be numbers, got a symbol; give steps=pm.Data(...) instead")
        inputs = of_each_record("inputs", self.inputs, records.labels)
        input_times = None
        if self.input_times is not None:
            input_times = of_each_record("input_times", self.input_times, records.labels)
            if any(isinstance(part, Variable) for part in inputs):
                raise ModelError("inputs must be numbers where input_times are given, got a symbol")
        timing = Timing(
            _by_record("steps", self.steps, records),
            _by_record("times", self._own_times(records), records),
            self.t0, self.unit, inputs, input_times, self.inputs_at,
            events_of_records(self.events, records.labels), earlier,
        )  # fmt: skip
        return place(system, timing, records.check_each)

    def _own_times(self, records: Records) -> Any:
        """The times that are given, else the dates that the data bring."""
        found = times_of_data(self.observed)
        for name in ("steps", "times", "panel", "censored"):
            _check_index(name, getattr(self, name), self.observed)
        if self.steps is not None or self.times is not None:
            if found is not None:
                _check_agree(self.times, found, records)
            return self.times
        if found is None and isinstance(self.observed, pd.Series | pd.DataFrame):
            raise ModelError(
                "observed brings no dates: give steps or times, or dates as its index (read text "
                "with pd.to_datetime, write index.to_timestamp() for periods), got the index "
                f"{shortened(self.observed.index)}{_column_of_dates(self.observed)}"
            )
        if found is None and self.observed is not None:
            raise ModelError("observed brings no dates: give steps or times")
        return found


def _column_of_dates(table: pd.Series | pd.DataFrame) -> str:
    """How a column of dates becomes the index, if a table has one."""
    columns = [] if isinstance(table, pd.Series) else table.columns
    names = [name for name in columns if are_dates(table[name])]
    return f"; its column {names[0]!r} has dates: .set_index({names[0]!r})" if names else ""


def _check_index(name: str, values: Any, observed: Any) -> None:
    """Raise if tables have the same rows in another order, as they are taken by position."""
    tables = (pd.Series, pd.DataFrame)
    if not (isinstance(values, tables) and isinstance(observed, tables)):
        return
    own, other = values.index, observed.index
    if len(own) == len(other) and not own.equals(other) and own.isin(other).all():
        raise ModelError(
            f"{name} must have its rows in the order of observed, got the index "
            f"{shortened(own.tolist())} beside {shortened(other.tolist())}: sort both alike, or "
            "give arrays (.to_numpy())"
        )


def _check_agree(times: Any, dates: Any, records: Records) -> None:
    """Raise unless the dates of the data are the times that are given, or increase beside numbers.

    Data whose rows are in another order would be taken by position.
    """
    remedy = "leave out times, or give observed without dates (.to_numpy())"
    if times is not None and are_dates(times) and np.shape(times) == np.shape(dates):
        given, own = date_index("times", times), date_index("observed", dates)
        if (other := np.flatnonzero(given != own)).size:
            at = int(other[0])
            raise ModelError(
                f"times must be the dates of observed, got times[{at}] = {given[at]}, where "
                f"observed has {own[at]}: {remedy}"
            )
    for rows in records.slices() if records.is_panel else [slice(None)]:
        if not pd.Index(dates[rows]).is_monotonic_increasing:
            raise ModelError(
                "the dates of observed must increase, as steps and times do: sort its rows"
            )


def _by_record(name: str, values: Any, records: Records) -> list[Any] | None:
    """What each row has, as a list with the rows of each record."""
    if values is None or not records.is_panel:
        return None if values is None else [values]
    array = values if are_dates(values) else np.asarray(values)
    n_rows = int(records.starts[-1])
    if np.shape(array) != (n_rows,):
        raise ModelError(
            f"{name} must have shape ({n_rows},), one for each row of panel, got shape "
            f"{np.shape(array)}"
        )
    return [array[rows] for rows in records.slices()]


def of_each_record(name: str, values: Any, labels: Sequence[Any]) -> list[Any]:
    """The inputs of each record, or their times: their own, or the same for all.

    A single record has the label None.
    """
    own = None if list(labels) == [None] else own_inputs(values, labels, name)
    return [values] * len(labels) if own is None else own


def events_of_records(events: Any, labels: Sequence[Any]) -> list[Any]:
    """The table of events of each record: their own, by label or in order, or one for all."""
    is_table = isinstance(events, pd.DataFrame) or (isinstance(events, Mapping) and TIME in events)
    if events is None or is_table or list(labels) == [None]:
        return [events] * len(labels)
    if isinstance(events, Mapping):
        if (wrong := [label for label in labels if label not in events]) or (
            wrong := [label for label in events if label not in labels]
        ):
            raise ModelError(
                "events must have a table for each record, an empty one for a record without "
                f"events, got another label or none: {shortened(wrong)}"
            )
        return [events[label] for label in labels]
    if not isinstance(events, list | tuple) or len(events) != len(labels):
        raise ModelError(
            f"events must be a table for all records, or one for each of the {len(labels)}, got "
            f"{shortened(events)}"
        )
    return list(events)


def inputs_with_times(
    inputs: Any, input_times: Any, labels: Sequence[Any], clock: Clock
) -> tuple[list[Any], list[Any] | None]:
    """The inputs of each record, and their times: those given, else their own dates.

    None for inputs by step.
    """
    own, own_times = of_each_record("inputs", inputs, labels), None
    if input_times is not None:
        own_times = of_each_record("input_times", input_times, labels)
    return own, own_times if clock.unit is None else times_of_inputs(own, own_times)


def own_inputs(inputs: Any, labels: Sequence[Any], name: str = "inputs") -> list[Any] | None:
    """The inputs of each record, if they have their own: a mapping or a sequence of arrays."""
    if isinstance(inputs, Mapping):
        if set(inputs) != set(labels):
            missing = [label for label in labels if label not in inputs]
            raise ModelError(
                f"{name} must have an array for each record, got none for {shortened(missing)}"
                if missing
                else f"{name} must have an array for each record, got others: {shortened(inputs)}"
            )
        return [inputs[label] for label in labels]
    is_list = isinstance(inputs, list | tuple) and all(
        isinstance(part, np.ndarray | Variable | pd.Series | pd.DataFrame | xr.DataArray)
        and part.ndim
        for part in inputs
    )
    if not is_list and not (isinstance(inputs, np.ndarray) and inputs.ndim == 3):
        return None
    if len(inputs) != len(labels):
        raise ModelError(
            f"{name} must have an array for each of the {len(labels)} records, or one for "
            f"all, got {len(inputs)}"
        )
    return list(inputs)
