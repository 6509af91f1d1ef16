"""A panel from the table of pharmacometrics: rows of data, events, inputs and covariates."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ...errors import ModelError, ModelWarning, warn
from ..checks import check_finite
from .doses import doses_of, events_of, inputs_of
from .table import ClinicalTable, named, read_table


class ClinicalPanel(dict[str, Any]):
    """Arguments of `StateSpace`, and the constant covariates beside them.

    ``covariates`` (G, n) has a row for each person, whose labels are its index.
    """

    covariates: pd.DataFrame


def read_events(
    frame: pd.DataFrame,
    *,
    observables: Sequence[str] | Mapping[str, Any],
    compartments: Sequence[str] | Mapping[str, int] | None = None,
    covariates: Sequence[str] = (),
    changing: Sequence[str] = (),
    ss_doses: int | None = None,
    t0: float | None = None,
) -> ClinicalPanel:
    r"""Arguments of a panel from the table of pharmacometrics, a row for each dose or observation.

    The columns are ID, TIME and DV, and where needed AMT, RATE, CMT, EVID, MDV, ADDL, II, SS, CENS
    and DVID, in letters of any case.

    Parameters
    ----------
    frame : pandas.DataFrame
        The rows of a person (ID, integers or texts) are together and in the order of TIME, numbers
        in the unit of the system's ``dt``. NaN is no value.
    observables : sequence or mapping
        ``["conc"]``, the name of the only observable; ``{"conc": 1, "effect": 2}`` for several, by
        the column DVID, or CMT where there is none; a list of several has the texts there.
    compartments : sequence or mapping, optional
        Names of the compartments that CMT counts from 1, or ``{"central": 2}``. CMT may also hold
        the names. By default the numbers are the names.
    covariates : sequence of str
        Columns with one number for each person, for the attribute ``covariates`` of the result.
    changing : sequence of str
        Columns that are inputs of the system, of these names. A value holds from its row on, and
        the first one also before.
    ss_doses : int, optional
        For SS 1: how many earlier doses, each II apart, stand for the steady state. With the
        slowest rate k of a linear system, n doses leave a relative distance of at most
        :math:`e^{-k\,n\,II}`.
    t0 : float, optional
        The time at which the initial state holds in every record; by default the first time of all
        persons, earlier doses of SS 1 included, which must be one.

    Returns
    -------
    dict
        The arguments ``panel``, ``times``, ``observed`` and ``t0`` of `StateSpace`, and where the
        table has them

        * ``events``, doses given at once: ``dose_central`` is the amount into that compartment
          (``dose`` without CMT);
        * ``inputs`` and ``input_times``: ``infusion_central``, the sum of the rates of the
          infusions (RATE) that run, and ``changing``;
        * ``censored``: -1 where DV is a limit and the value below it (CENS 1), 1 where above
          (CENS -1).

        Its attribute ``covariates`` is a table whose index has the labels of the persons.

    Raises
    ------
    ModelError
        If a row makes no sense, with its label in ``frame``. EVID 3 and 4, RATE -1 and -2, SS 2, SS
        1 of an infusion or behind other rows, and LIMIT are refused.

    Warns
    -----
    ModelWarning
        If the frame has columns that nothing has read.

    Notes
    -----
    A row with EVID 0 or 2 is a row of the data; without DV, or with MDV 1, it is missing there, and
    the states are known at its time. At one time, the order of rows counts: a dose acts before the
    observation below it, and after the one above it. Doses that follow by ADDL have no row and act
    after. Bioavailability is up to the system: an ``event`` may multiply a dose, a drift the rate
    of an infusion, which then lasts as long.

    See Also
    --------
    pymc_statespace_filters.panel_from : A table without doses.

    Examples
    --------
    >>> import numpy as np
    >>> import pandas as pd
    >>> import pymc_statespace_filters as psf
    >>> frame = pd.DataFrame({
    ...     "ID": [1, 1, 1], "TIME": [0.0, 2.0, 20.0], "AMT": [100.0, 0.0, 0.0],
    ...     "ADDL": [1, 0, 0], "II": [12.0, 0.0, 0.0], "DV": [np.nan, 7.1, 9.3], "WT": 70.0,
    ... })
    >>> record = psf.pharmacometrics.read_events(frame, observables=["conc"], covariates=["WT"])
    >>> record["times"], record["events"][1]["time"].to_list()
    (array([ 2., 20.]), [0.0, 12.0])
    >>> float(record.covariates["WT"][1])
    70.0
    """
    table = read_table(frame)
    constant = _columns(table, "covariates", covariates)
    varying = _columns(table, "changing", changing)
    used = {*table.given.values(), *constant, *varying}
    if unused := [name for name in frame.columns if name not in used]:
        warn(
            f"columns of frame that are not used: {unused}; list them in covariates= or changing=, "
            "or drop them, frame.drop(columns=[...])",
            ModelWarning,
        )
    arguments = _data(table, observables)
    doses = doses_of(table, compartments, ss_doses)
    firsts = table["TIME"][table.records.starts[:-1]]
    for dose in doses:
        firsts[dose.record] = min(firsts[dose.record], dose.time)
    arguments["t0"] = start = _start(table.records.labels, firsts, t0)
    if any(not dose.rate for dose in doses):
        arguments["events"] = events_of(doses, table.records.labels)
    panel = ClinicalPanel(arguments | inputs_of(table, doses, varying, start))
    panel.covariates = _of_persons(table, constant)
    return panel


def _data(table: ClinicalTable, observables: Any) -> dict[str, Any]:
    """The rows of the data, one for each time of a person, and which values are limits."""
    names, column = _observables(table, observables)
    is_row, seen = ~table.is_dose, table.has_value
    number, time = table.records.of_rows()[is_row], table["TIME"][is_row]
    is_new = (np.diff(number, prepend=-1) != 0) | (np.diff(time, prepend=np.nan) != 0)
    row = np.zeros(len(is_row), dtype=np.int64)
    row[is_row] = np.cumsum(is_new) - 1
    cells = pd.DataFrame({"row": row, "column": column, "unseen": ~seen})
    table.refuse(
        seen & cells.duplicated(),
        "there is already a value of this observable at TIME {TIME}: give replicates observables "
        "of their own, by DVID, with the same equation",
    )
    shape = (is_new.sum(), len(names))
    observed, censored = np.full(shape, np.nan), np.zeros(shape)
    observed[row[seen], column[seen]] = table["DV"][seen]
    censored[row[seen], column[seen]] = 0.0 - table["CENS"][seen]  # below is -1 here
    data = {"observed": observed} | ({"censored": censored} if censored.any() else {})
    if len(names) > 1:
        data = {what: pd.DataFrame(values, columns=names) for what, values in data.items()}
    labels = np.array(table.records.labels, dtype=object)[number[is_new]]
    return {"panel": labels, "times": time[is_new]} | data


def _observables(table: ClinicalTable, observables: Any) -> tuple[list[str], np.ndarray]:
    """The names of observables, and the number of that of each row with a value."""
    known, by = named("observables", observables), "DVID" if "DVID" in table.given else "CMT"
    names = list(known)
    if isinstance(observables, Mapping) or len(names) > 1:
        found = table.names(by, known, table.has_value)
        return names, np.array([names.index(name) if name else 0 for name in found])
    if by in table.given and (keys := {*table[by][table.has_value]} - {None}):
        other = table[by] != min(keys, key=str)
        table.refuse(
            table.has_value & other & (len(keys) > 1),
            f"{by} is {{{by}}} here and another in other rows, so that there are several "
            f"observables: observables={{{{'{names[0]}': {{{by}}}, ...}}}}",
        )
    return names, np.zeros(len(table.frame), dtype=np.int64)


def _start(labels: Sequence[Any], firsts: np.ndarray, t0: Any) -> float:
    """The time at which all records start, given the first of each."""
    earliest, other = int(firsts.argmin()), int(np.argmax(firsts != firsts[0]))
    if t0 is None and other:
        raise ModelError(
            f"persons begin at different times, doses before a steady state included: ID "
            f"{labels[0]!r} at {firsts[0]:g}, ID {labels[other]!r} at {firsts[other]:g}: give "
            f"t0={firsts[earliest]:g} if the initial state holds there in all, or count TIME from "
            "the start of each"
        )
    start = check_finite("t0", firsts[0] if t0 is None else t0)
    if firsts[earliest] < start:
        raise ModelError(
            "t0 must not be after the first time of a person, doses before a steady state "
            f"included, got {start:g}, and ID {labels[earliest]!r} begins at {firsts[earliest]:g}"
        )
    return start


def _columns(table: ClinicalTable, argument: str, names: Any) -> dict[str, np.ndarray]:
    """Covariates by row, which have one value at one time."""
    columns = list(table.frame.columns)
    if isinstance(names, str) or any(name not in columns for name in names):
        raise ModelError(f"{argument} must list columns of frame, {columns}, got {names!r}")
    found = {name: table.numbers(name) for name in names}
    number, time = table.records.of_rows(), table["TIME"]
    at_once = (np.diff(number, prepend=-1) == 0) & (np.diff(time, prepend=np.nan) == 0)
    for name, values in found.items():
        table.refuse(np.isnan(values), f"the covariate {name} must have a value in every row")
        moves = at_once & (np.diff(values, prepend=np.nan) != 0)
        table.refuse(moves, f"the covariate {name} differs from that of the row above, at one TIME")
    return found


def _of_persons(table: ClinicalTable, constant: Mapping[str, np.ndarray]) -> pd.DataFrame:
    """The covariates of each record."""
    starts, number = table.records.starts[:-1], table.records.of_rows()
    for name, values in constant.items():
        table.refuse(
            values != values[starts][number],
            f"the covariate {name} differs from that in the first row of ID {{ID}}: list it in "
            "changing=, as an input of the system",
        )
    index = pd.Index(table.records.labels, name=table.given["ID"])
    return pd.DataFrame({n: values[starts] for n, values in constant.items()}, index=index)
