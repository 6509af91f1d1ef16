"""The user's times as numbers of the model, and back: numbers as they are, or dates."""

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from ..errors import ModelError
from .checks import check_finite, check_floats, shortened

# Only these: pandas takes the months "MS" for milliseconds, and "m" for minutes.
_UNITS = ("W", "D", "h", "min", "s", "ms", "us", "ns")


@dataclass(frozen=True)
class Clock:
    """What model times of the records of a variable mean to its user.

    Without a ``unit`` they are the user's numbers. With one, it is the duration of one unit of
    model time in nanoseconds, and ``origins`` are the dates at model time 0 of each record, or one
    for all, in nanoseconds since 1970; ``zoned``, whether the user's dates have a time zone.
    """

    unit: int | None = None
    origins: tuple[int, ...] = ()
    zoned: bool = False

    def stored(self) -> dict[str, Any]:
        """The clock as attributes of a stored result, see `restored`."""
        return {"unit": self.unit or 0, "origins": list(self.origins), "zoned": int(self.zoned)}

    @classmethod
    def restored(cls, attrs: Mapping[str, Any]) -> "Clock":
        """The clock of a stored result."""
        origins = tuple(map(int, np.atleast_1d(attrs["origins"])))
        return cls(int(attrs["unit"]) or None, origins, bool(attrs["zoned"]))

    def shown(self, times: Any, record: int = 0) -> Any:
        """The user's times: numbers, or dates (datetime64, UTC), rounded to 1e-9 of a unit."""
        times = np.asarray(times, dtype=np.float64)
        if self.unit is None:
            return times[()]
        # Microseconds hold all years; they are exact where they are far below a unit.
        quantum = 1 if self.unit < 10**6 else 1000
        origin = self.origins[record if len(self.origins) > 1 else 0]
        moved = np.round(times * (self.unit / quantum)).astype("int64")
        kind = "ns" if quantum == 1 else "us"
        return (origin // quantum + moved).astype(f"datetime64[{kind}]")[()]

    def numbers(self, name: str, times: Any, record: int = 0) -> np.ndarray:
        """Model times from the user's."""
        if not are_dates(times):
            if self.unit is not None:
                raise ModelError(
                    f"{name} must be dates, as those of the model are (read text with "
                    f"pd.to_datetime), got {shortened(times)}"
                )
            return numbers_of_time(name, times)
        if self.unit is None:
            raise ModelError(
                f"{name} must be numbers in the unit of dt, as those of the model are, got dates: "
                f"{shortened(times)}"
            )
        self._check_zone(name, times)
        origin = self.origins[record if len(self.origins) > 1 else 0]
        return _since(origin, _nanoseconds(name, times), self.unit)

    def _check_zone(self, name: str, times: Any) -> None:
        """Raise unless dates have a time zone as those of the model have one."""
        if has_zone(name, times) != self.zoned:
            remedy = (
                '.tz_localize(zone), or .tz_localize("UTC") for dates of results'
                if self.zoned
                else '.tz_convert("UTC").tz_localize(None)'
            )
            raise ModelError(
                f"{name} must have {'a' if self.zoned else 'no'} time zone, as the dates of the "
                f"model: write {remedy}, got {shortened(times)}"
            )


def clock_and_start(
    times: Sequence[Any] | None, t0: Any, unit: Any, name: str = "times"
) -> tuple[Clock, float]:
    """The clock of some records, given the times of each or None, and the model time of step 0."""
    if times is None or not are_dates(times[0]):
        if unit is not None:
            if times is not None:
                numbers_of_time(name, times[0])  # text and durations have advice of their own
            raise ModelError(
                f"unit must be None where {name} are not dates, got {unit!r}: numbers are in the "
                "unit of dt"
            )
        if are_dates(t0):
            raise ModelError(f"t0 must be a number where {name} are numbers, got {t0!r}")
        return Clock(), check_finite("t0", t0)
    if isinstance(t0, str):
        raise ModelError(f"t0 must be a number or a date, got text: write pd.Timestamp({t0!r})")
    if unit is None:
        raise ModelError(
            f"unit must be the duration of one unit of model time where {name} are dates, such as "
            'unit="D" where dt and rates count days, got None'
        )
    length, zoned = unit_of(unit), has_zone(name, times[0])
    if are_dates(t0):
        return Clock(length, (int(_nanoseconds("t0", [t0])[0]),), zoned), 0.0
    start = check_finite("t0", t0)
    moved = round(start * length)
    firsts = [int(_nanoseconds(name, own)[0]) - moved for own in times]
    return Clock(length, tuple(firsts), zoned), start


def unit_of(unit: Any) -> int:
    """A duration in nanoseconds: one of `_UNITS`, or a Timedelta."""
    length = 0
    if unit in _UNITS if isinstance(unit, str) else not isinstance(unit, bool | int | float):
        try:
            found = pd.Timedelta(1, unit=unit) if isinstance(unit, str) else pd.Timedelta(unit)
            length = found.as_unit("ns").value
        except (TypeError, ValueError, OverflowError):
            pass
    if length <= 0:
        raise ModelError(
            f"unit must be a duration: {', '.join(map(repr, _UNITS))} or a pandas.Timedelta (a "
            f"year is pd.Timedelta(days=365.25); months differ in length), got {unit!r}"
        )
    return int(length)


def unit_text(unit: int) -> str:
    """The unit of some nanoseconds as a user writes it, see `unit_of`."""
    names = (name for name in _UNITS if unit_of(name) == unit)
    found = next(names, None)
    return f'"{found}"' if found else f"pd.Timedelta('{pd.Timedelta(unit, unit='ns')}')"


def are_dates(times: Any) -> bool:
    """Whether times are dates and not numbers."""
    if isinstance(times, datetime.date | np.datetime64):
        return True
    dtype = getattr(times, "dtype", None)
    if isinstance(dtype, pd.DatetimeTZDtype) or getattr(dtype, "kind", "") == "M":
        return True
    if isinstance(times, list | tuple) or getattr(dtype, "kind", "") == "O":
        first = next(iter(np.ravel(np.asarray(times, dtype=object))), None)
        return isinstance(first, datetime.date | np.datetime64)
    return False


def times_of_data(observed: Any) -> Any:
    """The dates in the index of a table or along the first dimension of a DataArray, if any.

    Those of `simulate` are a coordinate beside the dimension, which counts steps.
    """
    index = getattr(observed, "index", None)
    if isinstance(index, pd.DatetimeIndex):
        return index
    dims, coords = getattr(observed, "dims", ())[:1], getattr(observed, "coords", {})
    along = [name for name in coords if coords[name].dims == dims and are_dates(coords[name])]
    named = [name for name in along if name in dims] or along
    return coords[named[0]].values if len(named) == 1 else None


def has_zone(name: str, dates: Any) -> bool:
    """Whether dates have a time zone."""
    return date_index(name, dates).tz is not None


def check_zones(dates: Mapping[str, Any]) -> None:
    """Raise unless all dates, by the names of their arguments, have a time zone or none has."""
    zones = {name: has_zone(name, own) for name, own in dates.items()}
    if len(set(zones.values())) > 1:
        aware = [name for name, zoned in zones.items() if zoned]
        naive = [name for name, zoned in zones.items() if not zoned]
        raise ModelError(
            f"{' and '.join(naive)} must have a time zone, as {' and '.join(aware)}, or none of "
            f"them: write .tz_localize(zone), got {shortened(dates[naive[0]])}"
        )


def numbers_of_time(name: str, times: Any) -> np.ndarray:
    """Times as floats; text and durations are refused."""
    array = np.asarray(times)
    is_text = array.dtype.kind in "SUO" and any(isinstance(t, str | bytes) for t in array.flat)
    if is_text:
        raise ModelError(
            f"{name} must be numbers in the unit of dt or dates, got text: read dates with "
            f"pd.to_datetime; got {shortened(times)}"
        )
    if array.dtype.kind == "m":
        raise ModelError(
            f"{name} must be numbers in the unit of dt or dates, got durations: write "
            f"{name} / np.timedelta64(1, 's') if dt is in seconds; got {shortened(times)}"
        )
    return check_floats(name, times, 1)


def _since(origin: int, dates: np.ndarray, unit: int) -> np.ndarray:
    moved = dates - origin
    # Numbers so small that they are exact as floats.
    common = np.gcd(np.gcd.reduce(moved), unit)
    return (moved // common) / (unit // common)


def _nanoseconds(name: str, dates: Any) -> np.ndarray:
    """Dates as nanoseconds since 1970; with a time zone, in UTC."""
    index = date_index(name, dates)
    if (missing := np.flatnonzero(index.isna())).size:
        raise ModelError(f"{name} must hold a date in every row, got none in row {missing[0]}")
    index = index if index.tz is None else index.tz_convert("UTC").tz_localize(None)
    return np.asarray(index.asi8)


def date_index(name: str, dates: Any) -> pd.DatetimeIndex:
    """Dates as an index of pandas."""
    dates = [dates] if np.ndim(dates) == 0 else dates
    try:
        return pd.DatetimeIndex(np.asarray(dates) if hasattr(dates, "dims") else dates).as_unit(
            "ns"
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise ModelError(
            f"{name} must be dates from 1678 to 2261, got {error}; give others as numbers, such as "
            "the days (dates - dates[0]) / np.timedelta64(1, 'D') of dates = np.array(..., "
            "'datetime64[D]')"
        ) from None
