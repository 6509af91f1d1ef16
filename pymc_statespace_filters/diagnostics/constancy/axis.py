"""The times of the rows of a scanned variable."""

from typing import Any, NamedTuple

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from ...pymc_model.term_scores import ScoredVariable

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
