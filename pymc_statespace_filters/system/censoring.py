"""Censored data: of which values the true one lies below or above the number recorded.

The flags of a record are columns of its steps, see `input_columns`: each stands in the row of the
step that begins at its observation.
"""

from typing import Any

import numpy as np
from pytensor.graph.basic import Variable

from ..errors import ModelError
from .labels import table_of
from .model import StateSpaceModel
from .time_axis import TimeAxis

_MEANING = "-1 where the true value lies below the number recorded, 1 where above, and 0 elsewhere"


def read_flags(censored: Any, system: StateSpaceModel) -> np.ndarray | None:
    """The flags with a column for each observable; None if none are given."""
    if censored is None:
        return None
    if isinstance(censored, Variable):
        raise ModelError("censored must be numbers, got a symbol")
    if np.asarray(censored).dtype == bool:
        raise ModelError(
            f"censored must be {_MEANING}, got truth values: write -1 * values or 1 * values"
        )
    return table_of("censored", censored, system.observables, "observables")


def check_flags(flags: np.ndarray, observed: Any, system: StateSpaceModel, n_rows: int) -> None:
    """Raise unless flags belong to values that are there; of symbolic data, that is not known."""
    if observed is None:
        raise ModelError("censored must be None where observed is None: simulations are complete")
    if flags.shape != (n_rows, system.p):
        raise ModelError(
            f"censored must have the shape of observed, {(n_rows, system.p)} (observations x "
            f"observables), got {flags.shape}"
        )
    _check_each(~np.isin(flags, (-1.0, 0.0, 1.0)), flags, system, f"must be {_MEANING}")
    if isinstance(observed, np.ndarray):
        is_wrong = (flags != 0.0) & np.isnan(observed)
        reason = "must be 0 where observed is NaN, which has no limit"
        _check_each(is_wrong, flags, system, reason)


def _check_each(
    is_wrong: np.ndarray, flags: np.ndarray, system: StateSpaceModel, reason: str
) -> None:
    if is_wrong.any():
        row, column = np.argwhere(is_wrong)[0]
        raise ModelError(
            f"censored {reason}, got {flags[row, column]:g} in row {row}, column "
            f"{system.observables[column]!r}"
        )


def with_flags(axis: TimeAxis, flags: np.ndarray, system: StateSpaceModel) -> TimeAxis:
    """The axis of a record with its flags (J, p) behind what other columns its steps have."""
    others = np.zeros((0, system.n_step_columns - system.p))
    others = others if axis.columns is None else axis.columns
    columns = np.zeros((max(len(others), int(axis.steps[-1]) + 1), system.n_step_columns))
    columns[: len(others), : -system.p] = others
    columns[axis.steps, -system.p :] = flags
    return axis._replace(columns=columns)
