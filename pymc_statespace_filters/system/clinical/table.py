"""The table of pharmacometrics, a row for each dose or observation: its columns, and checks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from ...errors import ModelError
from ..checks import is_finite, shortened
from ..clock import are_dates
from ..panel_records import Records, records_of

_OF_A_DOSE = ("AMT", "RATE", "II", "ADDL", "SS")
_NUMBERS = (*_OF_A_DOSE, "TIME", "DV", "EVID", "MDV", "CENS", "LIMIT")
_NAMES = ("ID", "CMT", "DVID")
_OWN = "give what begins anew an ID of its own, with TIME from its start"
_AS_ROWS = "write its doses as rows, with ADDL and II"


@dataclass(eq=False)
class ClinicalTable:
    """The columns of a frame by their names in capitals, and its records.

    ``given`` are the frame's own names of these columns; columns of numbers are zero where the
    frame has none.
    """

    frame: pd.DataFrame
    given: dict[str, Any]
    columns: dict[str, np.ndarray] = field(default_factory=dict)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]

    @cached_property
    def records(self) -> Records:
        """The records of the rows."""
        return records_of(self["ID"])

    @property
    def is_dose(self) -> np.ndarray:
        """Where a row is a dose, and not a row of the data."""
        return self["EVID"] == 1.0

    @property
    def has_value(self) -> np.ndarray:
        """Where DV is an observation."""
        return (self["EVID"] == 0.0) & (self["MDV"] != 1.0) & ~np.isnan(self["DV"])

    def refuse(self, wrong: Any, message: str, **values: Any) -> None:
        """Raise for the first row that is wrong, with values of its columns in the message."""
        if not (wrong := np.asarray(wrong)).any():
            return
        row = int(np.argmax(wrong))
        own = {name: column[row] for name, column in (self.columns | values).items()}
        shown = {n: f"{v:.15g}" if isinstance(v, float) else repr(v) for n, v in own.items()}
        label = self.frame.index.tolist()[row]
        raise ModelError(f"row {label!r} of frame: {message.format(**shown)}")

    def numbers(self, name: Any) -> np.ndarray:
        """The numbers of a column, NaN where there is none."""
        column = self.frame[name]
        if are_dates(column) or column.dtype.kind == "m":
            raise ModelError(
                f"column {name!r} of frame must hold numbers, got {column.dtype}: count time from "
                f"a start, (frame[{name!r}] - start) / pd.Timedelta('1h')"
            )
        self.refuse(
            [isinstance(value, str) for value in column],
            f"column {name!r} must hold numbers, got the text {{value}}; times are numbers in the "
            "unit of dt, and '.' is read as missing by pd.read_csv(..., na_values='.')",
            value=column.to_numpy(dtype=object),
        )
        numbers = column.to_numpy(dtype="float64", na_value=np.nan)
        message = f"column {name!r} must hold finite numbers, got {{value}}"
        self.refuse(np.isinf(numbers), message, value=numbers)
        return numbers

    def names(self, column: str, known: Mapping[str, Any], rows: np.ndarray) -> list[str]:
        """The names that a column gives rows, as such or by the value that is known of each."""
        if column not in self.columns:
            if len(known) > 1:
                raise ModelError(f"frame must have the column {column}, to tell {list(known)}")
            return [next(iter(known), "")] * len(self.frame)
        found = {value: name for name, value in known.items()} | {name: name for name in known}
        unknown = [key not in found for key in self[column]]
        expected = f"{known}".replace("{", "{{").replace("}", "}}")
        message = f"{column} {{{column}}} is not among the names and values {expected}"
        self.refuse(rows & np.array(unknown), message)
        return [found.get(key, "") for key in self[column]]


def named(argument: str, given: Any, values: Sequence[Any] | None = None) -> dict[str, Any]:
    """Names with the value of each in a column, given as a mapping, or as a list in order."""
    is_list = isinstance(given, list | tuple)
    known = dict(given) if isinstance(given, Mapping) else {}
    if is_list:
        known = dict(zip(given, given if values is None else values, strict=False))
    if not known or len({*known.values()}) != len(given):
        raise ModelError(
            f"{argument} must be a list of names or a mapping from names to the values in the "
            f"table, all different, got {shortened(given)}"
        )
    return known


def read_table(frame: Any) -> ClinicalTable:
    """Find the columns, whose names may have any case, and refuse rows that make no sense."""
    if not isinstance(frame, pd.DataFrame) or not len(frame):
        raise ModelError(f"frame must be a pandas.DataFrame with rows, got {shortened(frame)}")
    given: dict[str, Any] = {}
    for name in frame.columns:
        capital = str(name).upper()
        if capital in given:
            raise ModelError(f"frame must have one column {capital}, got {name!r} too: rename one")
        if capital in (*_NUMBERS, *_NAMES):
            given[capital] = name
    if missing := [name for name in ("ID", "TIME", "DV") if name not in given]:
        raise ModelError(
            f"frame must have the columns ID, TIME and DV, got none named {missing[0]} among "
            f"{list(frame.columns)}: rename with frame.rename(columns={{...}})"
        )
    table = ClinicalTable(frame, given)
    columns = table.columns
    for name in _NUMBERS:
        columns[name] = table.numbers(given[name]) if name in given else np.zeros(len(frame))
    for name in (*_OF_A_DOSE, "CENS"):
        columns[name] = np.nan_to_num(columns[name], nan=0.0)
    if "EVID" not in given:
        columns["EVID"] = (columns["AMT"] != 0.0).astype("float64")
    for name in _NAMES:
        if name in given:
            values = [_key(value) for value in frame[given[name]]]
            columns[name] = np.array([*values, None], dtype=object)[:-1]
    _check_order(table)
    _check_kinds(table)
    _check_doses(table)
    _check_values(table)
    return table


def _key(value: Any) -> Any:
    """A label, None if there is none; tables hold integers also as floats."""
    if pd.isna(value) or value == "":
        return None
    return int(value) if is_finite(value) and value == round(value) else value


def _check_order(table: ClinicalTable) -> None:
    table.refuse([label is None for label in table["ID"]], "ID must be a label, got {ID}")
    number, time = pd.factorize(table["ID"])[0], table["TIME"]
    again = number < np.maximum.accumulate(number)
    table.refuse(
        again, f"ID {{ID}} comes again behind others: sort the rows by ID and TIME, {_OWN}"
    )
    table.refuse(np.isnan(time), "TIME must be a number, got {TIME}")
    falls = (np.diff(number, prepend=-1) == 0) & (np.diff(time, prepend=time[0]) < 0)
    table.refuse(falls, "TIME {TIME} is before that of the row above: sort the rows by ID and TIME")
    for label, rows in zip(table.records.labels, table.records.slices(), strict=True):
        if table.is_dose[rows].all():
            raise ModelError(
                f"ID {label!r} of frame has doses and no observation: leave these rows out, or add "
                "one with EVID 2 at a time of interest"
            )


def _check_kinds(table: ClinicalTable) -> None:
    evid, refuse = table["EVID"], table.refuse
    refuse(
        np.isin(evid, (3, 4)), f"EVID {{EVID}} sets the state back, which is not supported: {_OWN}"
    )
    expected = "EVID must be 0 (observation), 1 (dose) or 2 (a time without either), got {EVID}"
    refuse(~np.isin(evid, (0, 1, 2)), expected)
    for name in _OF_A_DOSE:
        misplaced = ~table.is_dose & (table[name] != 0.0)
        refuse(
            misplaced, f"{name} {{{name}}} belongs to a dose, and EVID is {{EVID}}: make two rows"
        )
    if "CMT" in table.columns:
        is_off = [not isinstance(key, str | None) and key < 0 for key in table["CMT"]]
        refuse(is_off, "CMT {CMT} switches a compartment off, which is not supported")


def _check_doses(table: ClinicalTable) -> None:
    amount, rate, every, more, settled = (table[name] for name in _OF_A_DOSE)
    refuse, starts = table.refuse, np.isin(np.arange(len(amount)), table.records.starts)
    refuse(amount < 0, "AMT must not be negative, got {AMT}")
    refuse(table.is_dose & (amount == 0), "AMT must be positive where EVID is 1, got {AMT}")
    refuse(
        np.isin(rate, (-1, -2)),
        "RATE {RATE} is a rate or a duration to estimate: leave this row out, and write the "
        "infusion in the drift, with t and a parameter",
    )
    refuse(rate < 0, "RATE must be amount per time of an infusion, or 0 for a bolus, got {RATE}")
    refuse(every < 0, "II must be the time from dose to dose, got {II}")
    refuse((more < 0) | (more != np.round(more)), "ADDL must be a number of doses, got {ADDL}")
    no_time = ((more > 0) | (settled > 0)) & (every == 0)
    refuse(no_time, "ADDL {ADDL} with SS {SS} needs II, the time from dose to dose, got {II}")
    refuse(settled == 2, f"SS 2, on top of the present state, is not supported: {_AS_ROWS}")
    refuse(~np.isin(settled, (0, 1)), "SS must be 0 or 1, got {SS}")
    of_rate = (settled == 1) & (rate > 0)
    refuse(of_rate, f"SS 1 of an infusion, RATE {{RATE}}, is not supported: {_AS_ROWS}")
    refuse(
        (settled == 1) & ~starts,
        "SS 1 must be in the first row of a person, as its earlier doses would act on the rows "
        f"above: {_OWN}",
    )


def _check_values(table: ClinicalTable) -> None:
    refuse, flag, mdv = table.refuse, table["CENS"], table["MDV"]
    if "MDV" in table.given:
        refuse(~np.isin(mdv, (0, 1)), "MDV must be 0 or 1, got {MDV}")
        wrong = (mdv == 0) & ~table.has_value
        refuse(wrong, "MDV 0 says that DV is an observation, got {DV} with EVID {EVID}: write 1")
    refuse(~np.isin(flag, (-1, 0, 1)), "CENS must be 0, 1 (below) or -1 (above), got {CENS}")
    no_limit = (flag != 0) & ((table["EVID"] != 0) | np.isnan(table["DV"]))
    refuse(no_limit, "CENS {CENS} needs a limit in DV, got {DV} with EVID {EVID}")
    refuse(
        ("LIMIT" in table.given) & ~np.isnan(table["LIMIT"]),
        "LIMIT {LIMIT}, the other end of an interval (with CENS 0, of a truncation), is not "
        "supported: without the column, CENS 1 is any value below DV",
    )
