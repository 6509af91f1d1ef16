"""The steps of a record: those of a grid, or of times as they are.

Times on the grid ``t0 + k dt`` are numbers of its steps. Between other times a gap is divided into
the fewest equal steps of at most ``dt``, and every step has a length and a time of its own.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..errors import ModelError
from .steps import GRID_TOLERANCE, MOST_STEPS, check_steps, too_many_steps


class EventTimes(NamedTuple):
    """The times of events (R,), and which come before an observation at their time."""

    times: np.ndarray
    before: np.ndarray


NO_EVENTS = EventTimes(np.empty(0), np.empty(0, dtype=bool))


class TimeAxis(NamedTuple):
    """The steps of the observations of a record (J,), and where the steps lie.

    ``starts`` and ``lengths`` (K + 1,) are the time at which each step begins and its length, up to
    the last observation, which is at the beginning of step K; None for a grid. ``columns`` are what
    else each step has beside its inputs, see `input_columns`: rows for K + 1 steps at least, those
    that follow have zeros; None if a step has nothing else.
    """

    steps: np.ndarray
    t0: float
    dt: float
    starts: np.ndarray | None = None
    lengths: np.ndarray | None = None
    columns: np.ndarray | None = None

    def times(self, steps: Any) -> np.ndarray:
        """The times at which steps begin."""
        if self.starts is None:
            return np.asarray(self.t0 + np.asarray(steps) * self.dt, dtype=np.float64)
        return self.starts[steps]

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Time and length of every step up to the last observation and of the one that follows.

        The last step has the length 0 where no step follows.
        """
        if self.starts is not None and self.lengths is not None:
            return self.starts, self.lengths
        starts = self.times(np.arange(int(self.steps[-1]) + 1))
        return starts, np.full(starts.size, self.dt)

    def steps_of(self, events: EventTimes) -> tuple[np.ndarray, np.ndarray]:
        """The steps that begin with events (R,), and which of them are of this axis.

        An event that is not is later than the last observation, or earlier than the first step
        that has a length.
        """
        if self.starts is None or self.lengths is None:
            exact = (events.times - self.t0) / self.dt
            if exact.max(initial=0.0) > MOST_STEPS:
                raise too_many_steps(float(exact.max()))
            return np.round(exact).astype("int64"), np.ones(exact.size, dtype=bool)
        tolerance = GRID_TOLERANCE * self.dt
        first = np.searchsorted(self.starts, events.times - tolerance, side="left")
        last = np.searchsorted(self.starts, events.times + tolerance, side="right") - 1
        steps = np.where(events.before, first, last)
        end = self.starts[-1] + tolerance
        inside = (events.times <= end) & (events.times >= self.starts[0] - tolerance)
        return np.clip(steps, 0, self.starts.size - 1), inside

    def followed_by(
        self, times: np.ndarray, breaks: np.ndarray, events: EventTimes = NO_EVENTS
    ) -> "TimeAxis":
        """The axis with steps up to further times, which are those of its observations instead."""
        starts, lengths = self.rows()
        own = divided_axis(times, t0=float(starts[-1]), dt=self.dt, breaks=breaks, events=events)
        assert own.starts is not None
        assert own.lengths is not None
        return TimeAxis(
            own.steps + starts.size - 1,
            self.t0,
            self.dt,
            np.concatenate([starts[:-1], own.starts]),
            np.concatenate([lengths[:-1], own.lengths]),
        )


class TimesBetween(NamedTuple):
    """What an axis is made of: steps, or times, and when the inputs change and events are."""

    steps: np.ndarray | None
    times: np.ndarray
    t0: float
    breaks: np.ndarray
    events: EventTimes = NO_EVENTS


def off_grid(times: np.ndarray, t0: float, dt: float) -> np.ndarray:
    """How many steps each time is away from the grid."""
    exact = (times - t0) / dt
    return np.abs(exact - np.round(exact))


def is_grid(records: Sequence[TimesBetween], dt: float) -> bool:
    """Whether all times, changes of the inputs and events of some records lie on the grid.

    And no event comes before an observation at its time, which takes a step of length zero.
    """
    return all(
        (off_grid(times, one.t0, dt) <= GRID_TOLERANCE).all()
        for one in records
        for times in (one.times, one.breaks, one.events.times)
    ) and not any(preceding(one, dt).any() for one in records)


def preceding(given: TimesBetween, dt: float) -> np.ndarray:
    """Which of the events come before an observation at their time, (R,)."""
    return given.events.before & are_near(given.events.times, given.times, GRID_TOLERANCE * dt)


def are_near(times: np.ndarray, others: np.ndarray, tolerance: float) -> np.ndarray:
    """Which times are one of the others, which increase."""
    if not others.size:
        return np.zeros(times.shape, dtype=bool)
    nearest = np.clip(np.searchsorted(others, times - tolerance), 0, others.size - 1)
    return np.asarray(np.abs(others[nearest] - times) <= tolerance)


def axis_of(given: TimesBetween, dt: float, *, on_grid: bool) -> TimeAxis:
    """The axis of a record, as a grid or with steps of any length."""
    if not on_grid:
        return divided_axis(
            given.times, t0=given.t0, dt=dt, breaks=given.breaks, events=given.events
        )
    steps = given.steps
    if steps is None:
        whole = np.round((given.times - given.t0) / dt)
        if (np.abs(whole) > MOST_STEPS).any():
            raise too_many_steps(float(np.abs(whole).max()))
        steps = check_steps(whole.astype("int64"))
    return TimeAxis(steps, given.t0, dt)


def divided_axis(
    times: np.ndarray,
    *,
    t0: float,
    dt: float,
    breaks: np.ndarray,
    events: EventTimes = NO_EVENTS,
) -> TimeAxis:
    """The axis whose gaps between stops are divided into the fewest equal steps of at most ``dt``.

    Stops are times, breaks and events.
    """
    tolerance = GRID_TOLERANCE * dt
    at = np.maximum(times, t0)
    at[at - t0 <= tolerance] = t0
    inner = np.unique(np.concatenate([breaks, events.times]))
    inner = inner[(inner > t0 + tolerance) & (inner < at[-1] - tolerance)]
    # A change of the inputs, or an event, next to an observation is at the observation.
    inner = inner[~are_near(inner, at, tolerance)]
    inner = inner[np.diff(inner, prepend=-np.inf) > tolerance]
    first = np.sort(events.times[events.before])
    twice = np.unique(at[are_near(at, first, tolerance)])
    nodes = np.sort(np.concatenate([np.unique(np.append(at, t0)), inner, twice]))
    gaps = np.diff(nodes)
    counts = np.maximum(np.ceil(gaps / dt - GRID_TOLERANCE), 1.0)
    if counts.sum() > MOST_STEPS:
        raise too_many_steps(float(counts.sum()))
    counts = counts.astype("int64")
    ends = np.concatenate([[0], np.cumsum(counts)])
    lengths = np.repeat(gaps / counts, counts)
    number = np.arange(ends[-1]) - np.repeat(ends[:-1], counts)
    starts = np.repeat(nodes[:-1], counts) + number * lengths
    return TimeAxis(
        check_steps(ends[np.searchsorted(nodes, at, side="right") - 1]),
        t0,
        dt,
        np.append(starts, nodes[-1]),
        np.append(lengths, 0.0),
    )


def check_increasing(name: str, times: np.ndarray, label: Callable[[float], Any]) -> None:
    """Raise unless times increase strictly; ``label`` shows one as the user gave it."""
    if (falls := np.flatnonzero(np.diff(times) <= 0)).size:
        row = int(falls[0])
        raise ModelError(
            f"{name} must increase, got {name}[{row}] = {label(times[row])} followed by "
            f"{label(times[row + 1])} in row {row + 1}: sort the rows by time, and merge rows of "
            "one time"
        )
