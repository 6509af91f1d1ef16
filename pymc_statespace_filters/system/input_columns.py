"""Inputs of a user, and the columns that a system has beside them.

A row of inputs holds what is true during one step. The user gives the first columns. Behind them
are, in this order,

* of a system at any times, whose steps are not those of a grid, the step's length and the time at
  which it begins;
* for each number of steps for which some drifting parameters are held, a one where they move at the
  end of the step, and a zero elsewhere;
* of a system with events, a one where the step begins with an event, and the numbers of the event;
* of a system with censored data, for each observable the side on which a true value lies beside
  the one recorded at the beginning of the step: -1 below, 1 above, and 0 where it was measured;
* for each accumulator a one where the step begins at an observation at which it is set to zero, and
  a zero elsewhere.

So filters, simulations and forecasts treat lengths, times and the rest as they treat inputs.
Here the user's are checked, and these columns are made, read and hidden from the user.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytensor.tensor as pt
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Constant, Variable
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError, ModelWarning, warn
from .checks import shortened
from .labels import table_of
from .panel_records import FIRST_INPUT, RECORD, STEP
from .steps import GRID_TOLERANCE
from .time_axis import TimeAxis

if TYPE_CHECKING:
    from .model import StateSpaceModel


class InputRow(NamedTuple):
    """A row of inputs as a symbol: whole, the user's part, and the length and time of the step.

    The latter are None for a system on a grid. ``moves`` has an element for each number of steps
    for which parameters are held, and ``columns`` are the numbers of the step from `TimeAxis`, of
    which ``flags``, the last, are those of censored data, if there are any.
    """

    whole: TensorVariable
    of_user: TensorVariable
    length: TensorVariable | None
    time: TensorVariable | None
    moves: Mapping[int, TensorVariable]
    columns: TensorVariable
    flags: TensorVariable | None


def input_row(
    n_inputs: int,
    *,
    at_any_times: bool,
    n_accumulators: int,
    held_for: Sequence[int],
    n_of_step: int,
    n_censored: int,
) -> InputRow:
    """The symbol of a row; ``n_of_step`` are the columns of a `TimeAxis`."""
    first_move = n_inputs + 2 * at_any_times
    first_column = first_move + len(held_for)
    end = first_column + n_of_step
    n_columns = end + n_accumulators
    u = pt.tensor("u", shape=(n_columns,), dtype="float64")
    of_user = u[:n_inputs] if n_columns > n_inputs else u
    moves = {every: u[first_move + i] for i, every in enumerate(held_for)}
    columns = u[first_column:end]
    flags = u[end - n_censored : end] if n_censored else None
    if not at_any_times:
        return InputRow(u, of_user, None, None, moves, columns, flags)
    return InputRow(u, of_user, u[n_inputs], u[n_inputs + 1], moves, columns, flags)


def reset(
    x: TensorVariable, input_row: TensorVariable, accumulators: Sequence[int]
) -> TensorVariable:
    """The state from which a step begins, for the indices of the accumulators."""
    for column, i in enumerate(accumulators, -len(accumulators)):
        x = pt.set_subtensor(x[i], (1.0 - input_row[column]) * x[i])
    return x


def check_inputs(
    inputs: Any, system: "StateSpaceModel", axis: TimeAxis, steps: Variable | None = None
) -> Any:
    """The inputs as (rows, n_input_columns); row k holds during step k.

    Of a symbol, what is known is checked; ``steps`` is a symbol for those of the axis.
    """
    if isinstance(inputs, Variable):
        if isinstance(inputs, SharedVariable):
            _check_inputs_of_user(inputs.get_value(), system, axis)
        rows: Any = inputs[:, None] if inputs.type.ndim == 1 and system.n_inputs == 1 else inputs
        if not system.n_inputs or rows.type.ndim != 2:
            raise inputs_of_other_shape(system, rows.type)
    else:
        rows = _check_inputs_of_user(inputs, system, axis)
    return with_columns(system, rows, axis, steps)


def inputs_of_other_shape(system: "StateSpaceModel", found: Any) -> ModelError:
    """The error for inputs with other columns than those of the system."""
    return ModelError(
        f"inputs must have shape (steps, {system.n_inputs}), a column for each of "
        f"{list(system.inputs)}, got {found}"
    )


def _check_inputs_of_user(inputs: Any, system: "StateSpaceModel", axis: TimeAxis) -> np.ndarray:
    if inputs is None:
        if system.n_inputs:
            raise ModelError(
                f"inputs must have a row per step and a column for each of {list(system.inputs)}, "
                f"got None"
            )
        return np.zeros((0, 0))
    if not system.n_inputs:
        raise ModelError(
            f"inputs must be None for a system without inputs, got {shortened(inputs)}; name them "
            f"in the system (StateSpaceModel(inputs=[...]))"
        )
    array = table_of("inputs", inputs, system.inputs, "inputs")
    if array.ndim != 2 or array.shape[1] != system.n_inputs:
        raise inputs_of_other_shape(system, np.shape(inputs))
    needed = n_rows_of_user(system, axis.steps)
    if axis.starts is not None and len(array) not in (needed, axis.starts.size):
        raise ModelError(
            f"inputs must have times of their own (input_times=) where times are off the grid of "
            f"steps, or a row for each of the {axis.starts.size - 1} steps between them, got "
            f"{len(array)} rows"
        )
    if array.shape[0] < needed:
        last_row = ", and the observation uses u" if needed > axis.steps[-1] else ""
        raise ModelError(
            f"inputs must have at least {needed} rows, because the last observation is at step "
            f"{axis.steps[-1]} (row k holds during step k{last_row}), got {array.shape[0]}"
        )
    return array


def with_columns(
    system: "StateSpaceModel", inputs: Any, axis: TimeAxis, steps: Variable | None = None
) -> Any:
    """The user's inputs (..., rows, n_inputs) with all columns, of a record on this axis.

    Accumulators are set to zero at every observation, until `only_seen` knows the data. Inputs
    (rows, n_inputs) may be a symbol, and ``steps`` one for those of the axis.
    """
    if system.n_input_columns == system.n_inputs:
        return inputs
    xp: Any = pt if isinstance(inputs, Variable) or steps is not None else np
    at: Any = axis.steps if steps is None else steps
    if axis.starts is not None:
        n_rows: Any = axis.starts.size
    elif system.n_inputs:
        n_rows = inputs.shape[-2]
        if system.is_censored:
            n_rows = xp.maximum(n_rows, n_input_rows(system, axis.steps))
    else:
        n_rows = n_input_rows(system, at) if xp is np else pt.max(pt.concatenate([at, [0]]))
    columns: list[Any] = [axis.lengths, axis.starts] if axis.starts is not None else []
    columns += [_moves(xp.arange(n_rows), every, axis) for every in system.held_for]
    columns += _columns_of_step(axis, 0, n_rows, system.n_step_columns)
    if system.accumulators:
        at_observation = _replaced(xp.zeros(n_rows + 1), at, 1.0)
        columns += [at_observation] * len(system.accumulators)
    own = xp.stack(columns, axis=-1)
    if xp is np:
        own = np.broadcast_to(own, (*inputs.shape[:-2], *own.shape))
    if not system.n_inputs:
        return own.copy() if xp is np else own
    if axis.starts is not None or system.is_censored:  # the last row may be missing
        inputs = xp.concatenate([inputs, inputs[..., -1:, :]], axis=-2)[..., :n_rows, :]
    return xp.concatenate([inputs, own], axis=-1)


def _replaced(rows: Any, at: Any, values: Any) -> Any:
    """Rows, of which some are others; what falls past the last row is cut off with it."""
    if isinstance(rows, Variable):
        return pt.set_subtensor(rows[pt.clip(at, 0, rows.shape[0] - 1)], values)[:-1]
    rows[np.minimum(at, len(rows) - 1)] = values
    return rows[:-1]


def columns_between(
    system: "StateSpaceModel", inputs: np.ndarray, first: int, axis: TimeAxis, resets: np.ndarray
) -> np.ndarray:
    """Rows of all columns for steps from ``first`` on, of the user's inputs (m, n_inputs).

    ``axis`` has their starts and lengths, if they are not those of a grid; ``resets`` tells which
    accumulators start anew with the first of them.
    """
    own: list[Any] = [axis.lengths, axis.starts] if axis.starts is not None else []
    own += [_moves(first + np.arange(len(inputs)), every, axis) for every in system.held_for]
    own += _columns_of_step(axis, first, len(inputs), system.n_step_columns)
    if system.accumulators:
        is_first = np.arange(len(inputs)) == 0
        own += [is_first * reset for reset in resets]
    return np.column_stack([inputs, *own])


def _columns_of_step(axis: TimeAxis, first: int, n_rows: Any, n_columns: int) -> list[Any]:
    """The columns of an axis for steps from ``first`` on; zeros where it has none."""
    if not n_columns:
        return []
    known = np.zeros((0, n_columns)) if axis.columns is None else axis.columns[first:]
    if isinstance(n_rows, Variable):
        zeros = pt.zeros((pt.maximum(n_rows - len(known), 0), n_columns))
        rows = pt.concatenate([known, zeros])[:n_rows]
        return [rows[:, i] for i in range(n_columns)]
    rows = np.zeros((n_rows, n_columns))
    rows[: len(known), : known.shape[1]] = known[:n_rows]  # without flags, of a future
    return list(rows.T)


def _moves(number: Any, every: int, axis: TimeAxis) -> Any:
    """A one for each step, of these numbers, at whose end a parameter held for ``every`` moves."""
    if axis.starts is None or axis.lengths is None:
        is_symbol = isinstance(number, Variable)
        moves = pt.eq((number + 1) % every, 0) if is_symbol else (number + 1) % every == 0
        return moves.astype("float64")
    held = every * axis.dt
    begin = (axis.starts - axis.t0) / held + GRID_TOLERANCE
    end = begin + axis.lengths / held
    return np.asarray(np.floor(end) > np.floor(begin), dtype=np.float64)


def only_seen(system: "StateSpaceModel", inputs: Any, steps: Any, observed: Any) -> Any:
    """Inputs (..., rows, n_input_columns) of which an accumulator is set to zero if it was seen.

    That is, at those of the observations (J, p) that have an observable which reads it. ``steps``
    are those of the observations, (J,) or the table of a panel (J, 3), which holds numbers.
    """
    n = len(system.accumulators)
    if n == 0 or system.resets == "row" or observed is None:
        return inputs
    given = (inputs, steps, observed)
    inputs, steps, observed = (v.data if isinstance(v, Constant) else v for v in given)
    xp: Any = pt if any(isinstance(v, Variable) for v in (inputs, steps, observed)) else np
    seen, n_rows = seen_accumulators(system, observed), inputs.shape[-2]
    at = _rows_of(steps, n_rows)
    if xp is pt:  # data of other rows, where new ones are not set yet, say nothing
        n_known = pt.switch(pt.eq(at.shape[0], seen.shape[0]), seen.shape[0], 0)
        at, seen = pt.as_tensor(at)[:n_known], pt.as_tensor(seen)[:n_known]
    kept = _replaced(xp.ones((n_rows + 1, n)), at, seen)
    return xp.concatenate([inputs[..., :-n], inputs[..., -n:] * kept], axis=-1)


def seen_accumulators(system: "StateSpaceModel", observed: Any) -> Any:
    """Which accumulators (J, n) an observable reads that observations (J, p) have; 1 or 0."""
    xp = pt if isinstance(observed, Variable) else np
    is_there = (1 - xp.isnan(observed)) @ system.readers
    return xp.minimum(is_there, 1).astype("float64")


def resets_at(system: "StateSpaceModel", observed: np.ndarray) -> np.ndarray:
    """Which accumulators (n,) are set to zero after an observation (p,); 1 or 0."""
    if system.resets == "row":
        return np.ones(len(system.accumulators))
    return np.asarray(seen_accumulators(system, observed))


def warn_of_gaps_in_sums(system: "StateSpaceModel", observed: np.ndarray) -> None:
    """Warn where the user did not say whether sums go on over single gaps in the data (J, p)."""
    if not system.accumulators or system.names_resets or not np.isnan(observed).any():
        return
    unseen = 1 - seen_accumulators(system, observed)
    n_rows, missing = len(unseen), unseen.sum(axis=0).astype(int)
    for name, n_missing in zip(system.accumulators, missing.tolist(), strict=True):
        if 0 < n_missing < n_rows / 2:  # a sum of several rows is missing in most
            warn(
                f"{n_missing} of {n_rows} rows have no value of {name!r}, which sums on to the next"
                " value: if a value counts since the row before it, as weekly cases do, give "
                "StateSpaceModel(resets='row'); if it counts since the last value, give "
                "resets='seen', which ends this warning",
                ModelWarning,
            )


def _rows_of(steps: Any, n_rows: Any) -> Any:
    """The row of inputs of the step that begins at each observation; ``n_rows`` if there is none.

    The records of a panel have stretches of their own, one behind the other.
    """
    if steps.ndim == 1:
        return steps
    is_first = np.diff(steps[:, RECORD], prepend=steps[0, RECORD] - 1) != 0
    begins, ends = steps[is_first, FIRST_INPUT], np.append(steps[is_first, FIRST_INPUT][1:], n_rows)
    number = np.cumsum(is_first) - 1
    rows = begins[number] + steps[:, STEP]
    return np.where(rows < ends[number], rows, n_rows)


def with_resets(system: "StateSpaceModel", rows: np.ndarray, resets: Any) -> np.ndarray:
    """Rows of inputs (..., n_input_columns) with these numbers in the columns of accumulators."""
    rows = rows.copy()
    if system.accumulators:
        rows[..., -len(system.accumulators) :] = resets
    return rows


def inputs_of_user(system: "StateSpaceModel", rows: np.ndarray) -> np.ndarray:
    """The columns (..., n_inputs) that the user gave."""
    return rows[..., : system.n_inputs]


def columns_of_steps(system: "StateSpaceModel", rows: np.ndarray) -> np.ndarray | None:
    """The columns (rows, n) of a `TimeAxis` in rows of inputs (rows, n_input_columns)."""
    return rows[:, _of_step(system)] if system.n_step_columns else None


def without_events(system: "StateSpaceModel", rows: np.ndarray) -> np.ndarray:
    """Rows of inputs (..., n_input_columns) in which no step begins with an event."""
    rows = rows.copy()
    if system.events is not None:
        rows[..., _of_step(system).start] = 0.0
    return rows


def _of_step(system: "StateSpaceModel") -> slice:
    """Where the columns of a `TimeAxis` are in a row; with events, the first tells of one."""
    end = system.n_input_columns - len(system.accumulators)
    return slice(end - system.n_step_columns, end)


def flags_at(system: "StateSpaceModel", rows: np.ndarray, steps: Any) -> np.ndarray:
    """The flags (J, p) of the observations at these steps, of rows (rows, n_input_columns)."""
    columns = columns_of_steps(system, rows)
    if columns is None or not system.is_censored:
        return np.zeros((len(steps), system.p))
    return columns[steps, -system.p :]


def times_of_steps(system: "StateSpaceModel", inputs: Any, steps: Any, t0: Any) -> Any:
    """The times at which steps begin, from the inputs (rows, n_input_columns) of a record."""
    if system.is_at_any_times:
        return inputs[..., system.n_inputs + 1][steps]
    return t0 + steps * system.dt


def divided(system: "StateSpaceModel", rows: Any, factor: int) -> Any:
    """Rows (rows, n_input_columns) for a system whose steps are shorter by an integer factor."""
    xp = pt if isinstance(rows, Variable) else np
    repeated = xp.repeat(rows, factor, axis=-2)
    number = xp.arange(repeated.shape[-2]) % factor
    columns = [repeated[..., i] for i in range(system.n_input_columns)]
    if system.is_at_any_times:
        i = system.n_inputs
        columns[i] = columns[i] / factor
        columns[i + 1] = columns[i + 1] + number * columns[i]
    first_move = system.n_inputs + 2 * system.is_at_any_times
    is_last = xp.eq(number, factor - 1) if xp is pt else number == factor - 1
    for i in range(first_move, first_move + len(system.held_for)):
        columns[i] = columns[i] * is_last
    is_first = xp.eq(number, 0) if xp is pt else number == 0
    # A step, not each of its parts, begins with an event, and with sums that are zero again.
    at_begin = [-i for i in range(1, len(system.accumulators) + 1)]
    if system.events is not None:
        at_begin.append(_of_step(system).start)
    for i in at_begin:
        columns[i] = columns[i] * is_first
    return xp.stack(columns, axis=-1) if columns else repeated


def n_input_rows(system: "StateSpaceModel", steps: np.ndarray) -> int:
    """Number of rows of inputs that a record needs.

    One per step, and one more if the observation has the argument u.
    """
    return int(steps[-1]) + int(system.observation_uses_inputs) if steps.size else 0


def n_rows_of_user(system: "StateSpaceModel", steps: np.ndarray) -> int:
    """The same of what the user must give: flags alone need no value of inputs at the last step."""
    if system.is_censored and not system.observation_has_u:
        return int(steps[-1]) if steps.size else 0
    return n_input_rows(system, steps)
