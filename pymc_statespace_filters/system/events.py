"""Events: jumps of the state at known times, as columns of the steps of a record.

An event acts on the state at the beginning of a step. A state at an observation is the one before
the events there, unless an event is said to come ``before`` it: a step of length zero is then put
between the two.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ..errors import ModelError
from .checks import check_floats, shortened
from .clock import Clock
from .signature import BEFORE, TIME
from .time_axis import EventTimes, TimeAxis

if TYPE_CHECKING:
    from .model import StateSpaceModel


@dataclass(frozen=True, eq=False)  # arrays are not hashable, and a random variable holds this
class Events:
    """The events of a record: their times, and the numbers of each (R, n)."""

    at: EventTimes
    values: np.ndarray

    def columns(self, axis: TimeAxis, clock: Clock, record: int) -> np.ndarray:
        """For each step a one where it begins with an event, and the numbers of that event.

        Of an axis of any lengths, the steps up to the last one; of a grid, also those of later
        events. Steps without an event have the numbers of the first one, at which the event's
        expressions are defined. Raise if two events begin one step.
        """
        steps, inside = axis.steps_of(self.at)
        if (rows := np.flatnonzero(np.diff(steps[inside]) == 0)).size:
            row = int(rows[0])
            first, second = clock.shown(self.at.times[inside][row : row + 2], record)
            raise ModelError(
                f"events must be a millionth of a step apart, got {first} followed by {second}, "
                f"with no observation between them: merge them into one row"
            )
        n_rows = int(axis.steps[-1]) + 1
        if axis.starts is None and steps.size:
            n_rows = max(n_rows, int(steps.max()) + 1)
        columns = np.zeros((n_rows, 1 + self.values.shape[1]))
        columns[:, 1:] = self.values[0] if len(self.values) else 1.0
        columns[steps[inside], 0] = 1.0
        columns[steps[inside], 1:] = self.values[inside]
        return columns

    def followed_by(self, later: "Events", end: float, tolerance: float) -> "Events":
        """These events up to the observation at ``end``, and the later ones after it.

        One at ``end`` itself, after the observation, is the later one if there are two.
        """
        now = later._follow(end, tolerance)
        own = (self.at.times <= end + tolerance) & ~(now.any() & self._follow(end, tolerance))
        new = now | (later.at.times > end + tolerance)
        at = EventTimes(
            np.concatenate([self.at.times[own], later.at.times[new]]),
            np.concatenate([self.at.before[own], later.at.before[new]]),
        )
        return Events(at, np.concatenate([self.values[own], later.values[new]]))

    def _follow(self, end: float, tolerance: float) -> np.ndarray:
        """Which events come at a time, after the observation there."""
        return np.asarray((np.abs(self.at.times - end) <= tolerance) & ~self.at.before)


def with_events(axis: TimeAxis, events: Events | None, clock: Clock, record: int = 0) -> TimeAxis:
    """The axis with the columns of the events of its record."""
    if events is None:
        return axis
    return axis._replace(columns=events.columns(axis, clock, record))


def read_events(
    table: Any, system: "StateSpaceModel", clock: Clock, t0: float, record: int = 0
) -> Events | None:
    """Check the events of a record, a table with a column of times; None of a system without."""
    names = system.events
    if names is None:
        if table is not None:
            raise ModelError(
                "events must be None for a system without events, got "
                f"{shortened(table)}: say what one does in the system "
                "(StateSpaceModel(events=[...], event=...))"
            )
        return None
    columns = _columns(table, names)
    given = columns.pop(TIME)  # an empty column has no dates, even where times are dates
    times = clock.numbers(f"events[{TIME!r}]", given, record) if np.size(given) else np.zeros(0)
    before = columns.pop(BEFORE, np.zeros(times.size))
    values = [_numbers(name, columns[name], times.size) for name in names]
    flags = _numbers(BEFORE, before, times.size)
    if (wrong := np.flatnonzero((flags != 0.0) & (flags != 1.0))).size:
        raise ModelError(
            f"events[{BEFORE!r}] must be 1 where the event comes before an observation at its "
            f"time, else 0, got {flags[wrong[0]]:g} in row {wrong[0]}"
        )
    is_before = flags == 1.0
    _check_order(times, is_before, clock, t0, record)
    table_of_values = np.stack(values, axis=1) if values else np.zeros((times.size, 0))
    return Events(EventTimes(times, is_before), table_of_values)


def _columns(table: Any, names: tuple[str, ...]) -> dict[str, Any]:
    """The columns of a table of events, by name."""
    wanted = [TIME, *names]
    if not isinstance(table, pd.DataFrame | Mapping):
        raise ModelError(
            f"events must be a table with the columns {wanted} (a DataFrame, or a dict of "
            f"columns), empty for a record without events, got {shortened(table)}"
        )
    if isinstance(table, pd.DataFrame) and table.index.name == TIME:
        table = table.reset_index()
    found = {str(name): table[name] for name in table}
    if all(np.size(column) == 0 for column in found.values()):
        return {name: np.zeros(0) for name in wanted}
    missing = [name for name in wanted if name not in found]
    others = [name for name in found if name not in (*wanted, BEFORE)]
    if missing or others:
        raise ModelError(
            f"events must have the columns {wanted}, and may have {BEFORE!r}, got "
            + (f"none of the name {missing[0]!r}" if missing else f"also {others[0]!r}")
        )
    return found


def _numbers(name: str, values: Any, n_rows: int) -> np.ndarray:
    """The numbers of a column, one for each row or the same for all."""
    array = check_floats(f"events[{name!r}]", values, None)
    if array.shape not in ((), (n_rows,)):
        raise ModelError(
            f"events[{name!r}] must have a number for each of the {n_rows} times, got shape "
            f"{array.shape}"
        )
    return np.broadcast_to(array, (n_rows,))


def _check_order(
    times: np.ndarray, before: np.ndarray, clock: Clock, t0: float, record: int
) -> None:
    """Raise unless events come in order, and none before the start."""
    if times.size and times[0] < t0:
        start, first = clock.shown([t0, times[0]], record)
        raise ModelError(
            f"events must not lie before t0 = {start}, where the initial state holds, got one at "
            f"{first}"
        )
    falls = (np.diff(times) < 0) | ((np.diff(times) == 0) & (before[1:] >= before[:-1]))
    if (rows := np.flatnonzero(falls)).size:
        row = int(rows[0])
        first, second = clock.shown(times[row : row + 2], record)
        raise ModelError(
            f"events must increase in time, got {first} followed by {second} in row {row + 1}: "
            f"sort them, and merge those of one time into one row ({BEFORE!r} and then not "
            f"{BEFORE!r} an observation may be two)"
        )
