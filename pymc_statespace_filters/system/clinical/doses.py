"""Doses of a clinical table: those that a row stands for, as events and as rates of infusions."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from ..checks import check_count
from .table import ClinicalTable, named

# Times closer than this, relative to their size, are one: 0.1 * 3 is 0.3.
_ONE_TIME = 1e-9


class Dose(NamedTuple):
    """A dose of a record into a compartment: at once, or with a rate until ``end``.

    ``before`` says whether it acts before an observation at its time.
    """

    record: int
    time: float
    compartment: str
    amount: float
    rate: float
    end: float
    before: bool


def doses_of(table: ClinicalTable, compartments: Any, ss_doses: int | None) -> list[Dose]:
    """All doses: those of rows, those that follow by ADDL, and those before a steady state."""
    into = _compartments(table, compartments)
    if ss_doses is None:
        table.refuse(
            table["SS"] == 1.0,
            "SS 1 needs ss_doses=n, how many earlier doses stand for the steady state: they leave "
            "exp(-k n II) of the distance from it, with II = {II} and the slowest rate k",
        )
    earlier = 0 if ss_doses is None else check_count("ss_doses", ss_doses, 1)
    before, number = _before(table), table.records.of_rows()
    times = table.records.split(table["TIME"])
    doses = []
    for row in np.flatnonzero(table.is_dose):
        amount, rate, every = (float(table[name][row]) for name in ("AMT", "RATE", "II"))
        record = int(number[row])
        for k in range(-earlier if table["SS"][row] else 0, int(table["ADDL"][row]) + 1):
            time = _snapped(float(table["TIME"][row]) + k * every, times[record])
            end = _snapped(time + amount / rate, times[record]) if rate else time
            own = k == 0 and bool(before[row])
            doses.append(Dose(record, time, into[row], amount, rate, end, own))
    return doses


def events_of(doses: Sequence[Dose], labels: Sequence[Any]) -> dict[Any, pd.DataFrame]:
    """The table of events of each record, of those doses that are given at once."""
    columns, by_record = _sorted("dose", [dose for dose in doses if not dose.rate], len(labels))
    tables = {}
    for label, own in zip(labels, by_record, strict=True):
        amounts: dict[tuple[float, bool], dict[str, float]] = {}
        time = -np.inf
        for dose in sorted(own, key=lambda dose: dose.time):
            time = time if dose.time - time <= _ONE_TIME * abs(dose.time) else dose.time
            at = amounts.setdefault((time, not dose.before), dict.fromkeys(columns, 0.0))
            at[dose.compartment] += dose.amount
        order = sorted(amounts)
        table = {"time": [time for time, _ in order], "before": [not after for _, after in order]}
        table |= {name: [amounts[key][c] for key in order] for c, name in columns.items()}
        tables[label] = pd.DataFrame(table, dtype="float64")
    return tables


def inputs_of(
    table: ClinicalTable, doses: Sequence[Dose], changing: Mapping[str, np.ndarray], t0: float
) -> dict[str, Any]:
    """The inputs of each record and their times: sums of the rates that run, and covariates.

    A covariate has the value of a row from its time on, and that of the first row before it.
    """
    records = table.records
    infusions = [dose for dose in doses if dose.rate]
    columns, by_record = _sorted("infusion", infusions, len(records.labels))
    inputs, input_times = {}, {}
    for label, rows, own in zip(records.labels, records.slices(), by_record, strict=True):
        at_rows = table["TIME"][rows]
        turns = [time for dose in own for time in (dose.time, dose.end)]
        times = np.unique([t0, *turns, *(at_rows if changing else ())])
        values = {name: np.zeros(times.size) for name in columns.values()}
        for dose in own:
            runs = (times >= dose.time) & (times < dose.end)
            values[columns[dose.compartment]] += dose.rate * runs
        last = np.maximum(np.searchsorted(at_rows, times, side="right") - 1, 0)
        values |= {name: covariate[rows][last] for name, covariate in changing.items()}
        inputs[label], input_times[label] = pd.DataFrame(values), times
    return {"inputs": inputs, "input_times": input_times} if columns or changing else {}


def _sorted(prefix: str, doses: Sequence[Dose], n: int) -> tuple[dict[str, str], list[list[Dose]]]:
    """The name of a column for each compartment that has such doses, and the doses by record."""
    into = sorted({dose.compartment for dose in doses})
    by_record: list[list[Dose]] = [[] for _ in range(n)]
    for dose in doses:
        by_record[dose.record].append(dose)
    return {name: f"{prefix}_{name}" if name else prefix for name in into}, by_record


def _snapped(time: float, rows: np.ndarray) -> float:
    """The time of a row that differs from ``time`` by rounding alone, else ``time``."""
    nearest = float(rows[np.argmin(np.abs(rows - time))])
    return nearest if abs(nearest - time) <= _ONE_TIME * abs(time) else time


def _before(table: ClinicalTable) -> np.ndarray:
    """Where the row of a dose stands above those of observations at its time."""
    at = [table.records.of_rows(), table["TIME"]]
    groups = pd.Series(~table.is_dose).groupby(at)
    above = groups.cumsum().to_numpy()
    below = groups.transform("sum").to_numpy() - above
    table.refuse(
        table.is_dose & (above > 0) & (below > 0),
        "the dose stands between two observations at TIME {TIME}, which are one row of the data: "
        "put it above or below both, or give one of them another time",
    )
    return below > 0


def _compartments(table: ClinicalTable, compartments: Any) -> list[str]:
    """The name of the compartment of each row."""
    if compartments is not None:
        known = named("compartments", compartments, range(1, 1000))
    else:
        keys = dict.fromkeys(table.columns.get("CMT", ()))
        known = {str(key): key for key in keys if key is not None}
    return table.names("CMT", known, table.is_dose)
