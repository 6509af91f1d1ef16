"""The records that a system is compared with: observation steps, data, inputs and t0.

One record without a panel is a panel of one, and numbers are symbols that are known: one reader
takes all. A single evaluation takes all records. The rows of a panel are a table of integers
(J, 3), one for each observation: a code of the record that it belongs to, its step, and the row of
the inputs that holds during step 0 of that record. Records that share their inputs all begin at row
0; others have stretches of their own, one below the other. Every record starts at step 0 and time
t0; at dates, at its own first date.

The code of a record is its label, or a hash of it if that is a text. The noise of a record depends
on the seed and this code alone, so that it does not change when other records are added.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pytensor.tensor as pt
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Variable

from ..errors import ModelError
from .censoring import check_flags, read_flags, with_flags
from .checks import shortened
from .clock import Clock
from .events import Events
from .given_record import GivenRecord
from .input_columns import check_inputs, only_seen, warn_of_gaps_in_sums
from .labels import table_of
from .missing_codes import warn_of_missing_codes
from .model import StateSpaceModel
from .panel_records import ALONE, FIRST_INPUT, STEP, Records, records_of
from .placement import Earlier
from .time_axis import TimeAxis
from .timed_inputs import TimedInputs


class Record(NamedTuple):
    """A record, or those of a panel, on their axes of time.

    ``system`` is the one that takes the steps of these axes; ``steps`` (J,) are the rows (J, 3) of
    a panel, ``observed`` (J, p) is None in a simulation, and ``inputs`` are (rows,
    n_input_columns). ``steps``, ``observed``, ``inputs`` and ``n_records`` may be symbols; axes and
    records are then the current ones. ``timed`` are the inputs that have times of their own, and
    ``events`` those of each record.
    """

    system: StateSpaceModel
    clock: Clock
    records: Records
    n_records: Any
    axes: list[TimeAxis]
    steps: Any
    observed: Any
    inputs: Any
    timed: tuple[TimedInputs, ...]
    events: tuple[Events, ...]

    @property
    def is_panel(self) -> bool:
        """Whether the records have labels."""
        return self.records.is_panel

    @property
    def labels(self) -> list[Any] | None:
        """The labels of the records of a panel."""
        return self.records.labels if self.is_panel else None

    @property
    def t0(self) -> np.ndarray:
        """The model time of step 0 of every record."""
        return np.asarray(self.axes[0].t0)

    @property
    def arguments(self) -> tuple[Any, Any, Any, np.ndarray]:
        """Steps, data, inputs and t0, as a likelihood takes them."""
        return self.steps, self.observed, self.inputs, self.t0

    def each(self) -> list[tuple[Any, ...]]:
        """The same of every record alone, of numbers."""
        if not self.is_panel:
            return [self.arguments]
        return [
            (
                self.steps[own, STEP].copy(),
                None if self.observed is None else self.observed[own],
                self.inputs[self.steps[own.start, FIRST_INPUT] :],
                self.t0,
            )
            for own in self.records.slices()
        ]

    def times(self, steps: Sequence[np.ndarray]) -> np.ndarray:
        """The user's times of the given steps of each record, one after the other."""
        pairs = enumerate(zip(self.axes, steps, strict=True))
        return np.concatenate([self.clock.shown(axis.times(own), g) for g, (axis, own) in pairs])

    def coords(
        self, dim: str, steps: Sequence[np.ndarray], prefix: str = ""
    ) -> dict[str, tuple[str, np.ndarray]]:
        """Coordinates of the rows of a result, given the steps by record: step and time.

        Of a panel also the record; without one, the dimension counts steps.
        """
        at, times = np.concatenate(steps), self.times(steps)
        if not self.is_panel:
            return {dim: (dim, at), f"{prefix}time": (dim, times)}
        labels = np.repeat(np.array(self.records.labels), [len(one) for one in steps])
        return {
            f"{prefix}record": (dim, labels),
            f"{prefix}step": (dim, at),
            f"{prefix}time": (dim, times),
        }


def read_record(
    system: StateSpaceModel,
    given: GivenRecord,
    earlier: Earlier | None = None,
    *,
    symbolic: bool = False,
) -> Record:
    """Check every part of some records as far as it is known, and place them on steps.

    If ``symbolic``, steps, labels, data and inputs may be symbols, of which the values of shared
    data are checked.
    """
    if not symbolic:
        given.check_numbers()
    current = given.current()
    records = records_of(current.panel) if current.panel is not None else ALONE
    flags = read_flags(given.censored, system)
    is_censored = flags is not None and bool(flags.any())
    placed = current.placed(system.censored if is_censored else system, records, earlier)
    axes = placed.axes
    if not records.is_panel:
        records = records._replace(starts=np.array([0, axes[0].steps.size]))
    n_rows = int(records.starts[-1])
    data = _read_data(given.observed, system, n_rows)
    symbol = next((v for v in (given.steps, given.panel) if isinstance(v, Variable)), None)
    if flags is not None:
        known = data.get_value() if isinstance(data, SharedVariable) else data
        check_flags(flags, known, system, n_rows)
    if flags is not None and is_censored:
        if symbol is not None:
            raise ModelError("steps and panel must be numbers beside censored, got a symbol")
        pairs = zip(axes, records.slices(), strict=True)
        axes = [with_flags(axis, flags[own], placed.system) for axis, own in pairs]
    inputs, begins = read_inputs(placed.inputs, placed.system, records, axes, symbol)
    n_records, steps = _rows(given, records, axes, begins)
    inputs = only_seen(system, inputs, steps, data)
    return Record(
        placed.system, placed.clock, records, n_records, axes, steps, data, inputs, placed.timed,
        placed.events,
    )  # fmt: skip


def _rows(
    given: GivenRecord, records: Records, axes: Sequence[TimeAxis], begins: Any
) -> tuple[Any, Any]:
    """The number of records, and the steps (J,) of one, or the rows (J, 3) of a panel."""
    known = np.concatenate([axis.steps for axis in axes])
    steps = given.steps if isinstance(given.steps, Variable) else known
    if not records.is_panel:
        return 1, steps
    codes: Any
    n_records: Any
    number: Any
    if isinstance(given.panel, Variable):
        codes = pt.cast(given.panel, "int64")
        is_first = pt.neq(codes[1:], codes[:-1])
        n_records, number = 1 + is_first.sum(), pt.concatenate([[0], pt.cumsum(is_first)])
        begins = begins if begins is None else pt.as_tensor(begins)
    else:
        n_records, number = len(records.labels), records.of_rows()
        codes = records.codes[number]
    columns = [codes, steps, codes * 0 if begins is None else begins[number]]
    if any(isinstance(column, Variable) for column in columns):
        return n_records, pt.stack([pt.cast(pt.as_tensor(c), "int64") for c in columns], axis=1)
    return n_records, np.stack(columns, axis=1)


def _read_data(observed: Any, system: StateSpaceModel, n_rows: int) -> Any:
    """The data (J, p), if there are any; of a symbol, what is known is checked."""
    if isinstance(observed, Variable) and observed.type.ndim != 2:
        raise ModelError(
            "observed must have 2 dimensions (rows, observables) if it is symbolic, as pm.Data is, "
            f"got {observed.type.ndim}: for one observable give it values[:, None]"
        )
    is_shared = isinstance(observed, SharedVariable)
    if observed is None or (isinstance(observed, Variable) and not is_shared):
        return observed
    data = check_observed(observed.get_value() if is_shared else observed, system, n_rows)
    warn_of_missing_codes(system, data)
    warn_of_gaps_in_sums(system, data)
    return observed if is_shared else data


def check_system(system: Any) -> None:
    """Raise unless ``system`` is a `StateSpaceModel`."""
    if not isinstance(system, StateSpaceModel):
        raise ModelError(f"system must be a StateSpaceModel, got {system!r}")


def check_observed(observed: Any, system: StateSpaceModel, n_observations: int) -> np.ndarray:
    """The data as (J, p); NaN marks what is missing."""
    array = table_of("observed", observed, system.observables, "observables", missing=True)
    if array.shape != (n_observations, system.p):
        raise ModelError(
            f"observed must have shape {(n_observations, system.p)} (observations x observables), "
            f"got {np.shape(observed)}"
        )
    return array


def read_inputs(
    parts: Sequence[Any],
    system: StateSpaceModel,
    records: Records,
    axes: Sequence[TimeAxis],
    steps: Variable | None = None,
) -> tuple[Any, Any]:
    """All rows of inputs, given those of each record, and the first row of each.

    None if all records share the rows, as they do if their inputs are one object. ``steps`` is a
    symbol for those of the axes, or for the labels of a panel.
    """
    has_own_columns = system.n_input_columns > system.n_inputs
    is_symbol = any(isinstance(v, Variable) for v in (steps, *parts))
    if records.is_panel and has_own_columns and is_symbol:
        raise ModelError(
            "panel, steps and inputs must be numbers in a panel of a system with accumulators, "
            "which are reset at the steps of each record, with events, with parameters that are "
            "held for several steps, with censored data, or at times off the grid, got a symbol"
        )
    rows = records.check_each(lambda one, axis: check_inputs(one, system, axis, steps), parts, axes)
    if len(rows) == 1 or (not has_own_columns and all(one is parts[0] for one in parts)):
        return rows[0], None
    xp: Any = pt if any(isinstance(one, Variable) for one in rows) else np
    ends = xp.cumsum(xp.stack([one.shape[0] for one in rows]))
    return xp.concatenate(rows), xp.concatenate([[0], ends[:-1]])


def check_seed(name: str, seed: Any) -> np.ndarray:
    """Return seeds as an array of 64-bit integers."""
    array = np.asarray(seed)
    if array.dtype.kind not in "iu":
        raise ModelError(f"{name} must be an integer, got {shortened(seed)}")
    if (array > np.iinfo("int64").max).any():
        raise ModelError(f"{name} must be below 2**63, got {shortened(seed)}")
    return array.astype("int64")
