"""The table of `drift_scan`, with the times of the rows."""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ...pymc_model.term_scores import ScoredVariable
from ...tables import SentenceTable
from .statistics import Statistics, p_values

LEVEL = 0.05
LEAST_SHARE = 0.05  # of the information, before and after a change
# Share of the statistic of the first parameter from which another may be the one that varies. Of 20
# jumps of two stiffnesses of an oscillator four were put on the wrong one, which had 1.1 to 1.5
# times the statistic of the right one in three of them.
ALIKE = 0.5

Array = NDArray[np.float64]


class TimeAxis(NamedTuple):
    """The times (J,) of the rows as shown and since the row before, and the records of the rows.

    ``labels`` has that of each record of a panel.
    """

    shown: np.ndarray
    durations: Array
    labels: list[Any]
    of_rows: NDArray[np.int64]

    @property
    def is_panel(self) -> bool:
        """Whether there are records with labels."""
        return self.labels != [None]

    @classmethod
    def of(cls, model: pm.Model, variable: ScoredVariable) -> "TimeAxis":
        """That of a variable of a model."""
        times, of_rows = variable.times, variable.of_rows
        is_first = np.diff(of_rows, prepend=-1) > 0
        durations = np.where(is_first, times - variable.t0, np.diff(times, prepend=0.0))
        parts = enumerate(variable.records.split(times))
        shown = np.concatenate([variable.clock.shown(own, number) for number, own in parts])
        return cls(shown, durations, _labels(model, variable), of_rows)


def _labels(model: pm.Model, variable: ScoredVariable) -> list[Any]:
    if not variable.is_panel:
        return [None]
    labels = list(model.coords[f"{variable.name}_record"])
    # The rows may have been set to those of other records.
    return labels if len(labels) == variable.n_records else variable.records.labels


class DriftScan(SentenceTable):
    """A DataFrame with a row for each parameter, most suspicious first, and the paths of its sums.

    Attributes
    ----------
    paths : xarray.Dataset
        For `plot_drift`: along ``parameter`` and the rows of the data ``cumulated``, the sum of the
        scores before each row in standard deviations, and ``band``, within which the whole path of
        a constant parameter stays with 95 % probability; ``turn`` is the number of the row in
        ``time``. In a panel the sum is that of the rows
        from each one to the end of its record, with the sign changed, so that it ends at zero.
    """

    _metadata: ClassVar[list[str]] = ["sentences", "paths"]
    main_columns = ("p_value", "p_alone", "statistic", "record", "time", "change")

    paths: xr.Dataset

    def _texts(self, name: str) -> list[str]:
        return [_text(name, value) for value in self[name]]


def _text(name: str, value: Any) -> str:
    if name.startswith("p_"):
        return f"{value:.3f}"
    if isinstance(value, pd.Timestamp) and value == value.normalize():
        return str(value.date())
    if isinstance(value, float):
        return f"{value:g}" if name == "time" else f"{value:.3g}"
    return str(value)


def scan_table(
    found: Statistics, labels: list[str], axis: TimeAxis, left_out: Sequence[str] = ()
) -> DriftScan:
    """The table of parameters with these labels, most suspicious first.

    Those that are ``left_out`` have no influence on the likelihood at the estimate.
    """
    values = p_values(found.data, found.simulated)
    at = _turns(found, len(axis.labels))
    columns: dict[str, Any] = {
        "p_value": values.adjusted,
        "p_alone": values.alone,
        "statistic": (found.data - found.simulated.mean(axis=0)) / found.simulated.std(axis=0),
    }
    if axis.is_panel:
        columns["record"] = [axis.labels[axis.of_rows[i]] for i in at]
    columns |= {"time": axis.shown[at], "change": _changes(found, at)}
    table = pd.DataFrame(columns, index=pd.Index(labels, name="parameter"))
    table = table.sort_values(["p_alone", "statistic"], ascending=[True, False], kind="stable")
    text = sentences(table, len(found.simulated))
    if left_out:
        text.append(
            f"Left out: {', '.join(left_out)}. At the estimate small changes have no effect on the "
            "likelihood, as those of a noise at zero."
        )
    return DriftScan(table, paths=_paths(found, labels, axis, at), sentences=text)


def _turns(found: Statistics, n_records: int) -> NDArray[np.int64]:
    """The rows (k,) before which parameters change, if they jump once: the likeliest, nearly.

    The gain of log-likelihood by a jump is half of R^2 / [A (1 - A / V)], with the information A
    in the rows after it and V in all.
    """
    share = found.information / found.total
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = found.remaining**2 / (share * (1 - share))
    inside = (share > LEAST_SHARE / n_records) & (share < 1 - LEAST_SHARE / n_records)
    return np.asarray(np.where(inside, gain, -1.0).argmax(axis=0))


def _changes(found: Statistics, at: NDArray[np.int64]) -> Array:
    """The changes (k,) of parameters that jump once, at rows (k,), to first order."""
    k = np.arange(len(at))
    after = found.information[at, k]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(found.remaining[at, k] * found.total / (after * (found.total - after)))


def _paths(
    found: Statistics, labels: list[str], axis: TimeAxis, at: NDArray[np.int64]
) -> xr.Dataset:
    sd = np.sqrt(found.total)
    sums = -found.remaining / sd
    band = np.quantile(found.largest / sd, 1 - LEVEL, axis=0)
    rows = "row" if axis.is_panel else "time"
    coords: dict[str, Any] = {"parameter": labels, "time": (rows, axis.shown)}
    if axis.is_panel:
        coords["record"] = (rows, np.array(axis.labels)[axis.of_rows])
    return xr.Dataset(
        {
            "cumulated": (("parameter", rows), sums.T),
            "band": ("parameter", band),
            "turn": ("parameter", at),
        },
        coords=coords,
    )


def sentences(table: pd.DataFrame, n_simulated: int) -> list[str]:
    """What the display says below the columns."""
    found = [
        f"p_value is for all {len(table)} parameters together, p_alone for one; from {n_simulated} "
        "simulated data sets with constant parameters, each estimated anew."
    ]
    varying = table[table["p_value"] <= LEVEL]
    alike = table["statistic"] >= ALIKE * table["statistic"].iloc[0]
    rivals = [str(name) for name in table.index[alike & (table["p_alone"] <= LEVEL)]]
    is_open = len(varying) > 0 and len(rivals) > 1
    for name, row in varying.astype(object).iterrows():  # a whole number stays one
        way = "rises" if row["change"] > 0 else "falls"
        where = f" in record {row['record']!r}" if "record" in row else ""
        size = float(f"{abs(row['change']):.2g}")  # 240, not 2.4e+02
        verb = "may vary" if is_open and name in rivals else "varies"
        found.append(
            f"{name} {verb}: if it is one jump, it {way} by about {size:g} before the row at "
            f"{_text('time', row['time'])}{where}."
        )
    if is_open:
        found.append(
            f"The scan cannot tell {', '.join(rivals[:-1])} and {rivals[-1]} apart: let each drift "
            "in a model of its own by psf.drifting, and compare the evidences of these models by "
            "psf.compare_evidence."
        )
    elif len(varying) > 1:
        found.append(
            f"Begin with {varying.index[0]}: a large change of one parameter leaves large "
            "residuals, which make others seem to vary. Let it drift by psf.drifting, and scan "
            "that model."
        )
    return found
