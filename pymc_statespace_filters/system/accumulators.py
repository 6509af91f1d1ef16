"""Accumulators: states that are zero again right after every observation.

A system with accumulators has one more column of inputs than its user gives: the last one, which is
1 at the steps of the observations and 0 at the others. A step that begins with 1 begins with
accumulators of zero. So filters, simulations and forecasts treat them as any other state. Here this
column is made, read and hidden from the user.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

if TYPE_CHECKING:
    from .model import StateSpaceModel


def reset(
    x: TensorVariable, input_row: TensorVariable, accumulators: Sequence[int]
) -> TensorVariable:
    """The state from which a step begins, for the indices of the accumulators."""
    for i in accumulators:
        # A product, because a switch would count as an equation with a kink.
        x = pt.set_subtensor(x[i], (1.0 - input_row[-1]) * x[i])
    return x


def with_resets(system: "StateSpaceModel", inputs: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """The user's inputs (..., rows, n_inputs) with the column of resets, 1 at ``steps``."""
    if not system.accumulators:
        return inputs
    n_rows = inputs.shape[-2] if system.n_inputs else n_input_rows(system, steps)
    column = np.zeros((n_rows, 1))
    column[steps[steps < n_rows]] = 1.0
    if not system.n_inputs:
        return np.broadcast_to(column, (*inputs.shape[:-2], n_rows, 1)).copy()
    return np.concatenate([inputs, np.broadcast_to(column, (*inputs.shape[:-1], 1))], axis=-1)


def with_symbolic_resets(system: "StateSpaceModel", inputs: Any, steps: Any) -> TensorVariable:
    """The same for symbols or numbers, inputs (rows, n_inputs) and steps (J,)."""
    steps = pt.as_tensor(steps)
    if system.n_inputs:
        n_rows = pt.as_tensor(inputs).shape[0]
    else:
        n_rows = pt.max(pt.concatenate([steps, [0]]))
    # Steps past the last row fall on one row more, which is cut off.
    column = pt.set_subtensor(pt.zeros(n_rows + 1)[pt.clip(steps, 0, n_rows)], 1.0)[:-1, None]
    return pt.concatenate([inputs, column], axis=1) if system.n_inputs else column


def without_resets(system: "StateSpaceModel", rows: np.ndarray) -> np.ndarray:
    """Rows of a system's inputs (..., n_input_columns) at which no accumulator is set to zero."""
    rows = rows.copy()
    rows[..., system.n_inputs :] = 0.0
    return rows


def inputs_of_user(system: "StateSpaceModel", rows: np.ndarray) -> np.ndarray:
    """The columns (..., n_inputs) that the user gave."""
    return rows[..., : system.n_inputs]


def n_input_rows(system: "StateSpaceModel", steps: np.ndarray) -> int:
    """Number of rows of inputs that a record needs.

    One per step, and one more if the observation has the argument u.
    """
    return int(steps[-1]) + int(system.observation_uses_inputs) if steps.size else 0
