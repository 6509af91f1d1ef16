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
        name = variable.name
        row_dim = model.named_vars_to_dims[name][0]
        if variable.is_panel:
            times = model[f"{name}_time"].get_value()
            labels = list(model.coords[f"{name}_record"])
        else:
            times, labels = np.asarray(model.coords[row_dim]), [None]
        shown = variable.clock.shown(times) if variable.is_panel else times
        if not np.issubdtype(times.dtype, np.number):
            times = (times - times[0]) / np.timedelta64(1, "s")
        return cls(shown, _durations(times.astype(float), variable), labels, variable.of_rows)


def _durations(times: Array, variable: ScoredVariable) -> Array:
    """Times since the row before; of the first row of a record since its step 0."""
    steps, firsts = variable.steps, np.diff(variable.of_rows, prepend=-1) > 0
    durations, n_steps = np.diff(times, prepend=0.0), np.diff(steps, prepend=0)
    inside = ~firsts & (n_steps > 0)
    length = durations[inside].sum() / n_steps[inside].sum() if inside.any() else 1.0
    return np.where(firsts, steps * length, durations)
