"""What passes between Python, graphs and a compiled filter.

    int64 run(const Plan*, const Record*, const Request*, Results*)

A *plan* is what a filter and a system are in machine code: sizes, settings, and addresses of the
functions of the system. A *record* is the data and the parameters, a *request* what belongs to one
call, as a seed, and *results* are the places that the call writes to. Each is a vector of words of
eight bytes, whose slots have names. An address 0 means that something is not given or not wanted.
A panel is a record of several parts; a single record is a panel of one.

A call is made twice: with ``sizes_only`` it checks its arguments and writes the sizes of the
results; then the caller allocates these, and the function writes them. It returns a status, 0 or a
`Refusal`.
"""

import ctypes
import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple
from uuid import uuid4

import llvmlite.binding as llvm
import numpy as np
from numba import carray, types

from .entry_point import I64_PTR, EntryPoint
from .jit import njit_internal
from .outcome_code import OutcomeCode
from .slots import known_when_compiled


@known_when_compiled
class RecordSlots(NamedTuple):
    """Parameters (G, k), rows (J,) or (J, 3), data (J, p), inputs and starts, by address and size.

    Rows of width 1 are the steps of a single record, rows of width 3 those of `system.record`.
    """

    theta: int = 0
    n_records: int = 1
    n_theta: int = 2
    rows: int = 3
    n_rows: int = 4
    row_width: int = 5
    observed: int = 6
    n_observed: int = 7
    n_observables: int = 8
    inputs: int = 9
    n_input_rows: int = 10
    n_inputs: int = 11
    starts: int = 12  # time of step 0 of each record, or of all
    n_starts: int = 13


@known_when_compiled
class RequestSlots(NamedTuple):
    """What belongs to one call."""

    sizes_only: int = 0
    seed: int = 1
    normals: int = 2  # stored ones, in place of the seed
    n_normals: int = 3
    wanted: int = 4  # the steps at which states are wanted
    n_wanted: int = 5
    draw_seed: int = 6
    terms_bar: int = 7
    n_terms_bar: int = 8
    tape: int = 9
    n_tape: int = 10
    tape_width: int = 11
    rank: int = 12
    n_ranks: int = 13
    exchange: int = 14
    observer: int = 15  # of members, see `filters.ensemble.callbacks`
    observer_integers: int = 16
    observer_reals: int = 17
    replacement: int = 18  # a function to call instead of the filter, and its number of the record
    number: int = 19
    state: int = 20  # of the filter after earlier rows, from which it goes on
    n_state: int = 21
    n_before: int = 22  # states from which points go on, one each


@known_when_compiled
class ResultSlots(NamedTuple):
    """Sizes of the results, then their addresses."""

    n_points: int = 0
    n_terms: int = 1
    n_wanted: int = 2
    n_states: int = 3
    n_members: int = 4
    n_observables: int = 5
    n_tape: int = 6
    tape_width: int = 7
    n_normals: int = 8
    n_records: int = 9
    n_theta: int = 10
    n_state: int = 11
    terms: int = 12
    health: int = 13
    n_effective: int = 14
    mean: int = 15
    sd: int = 16
    cov: int = 17
    drawn: int = 18
    n_effective_wanted: int = 19
    members: int = 20
    weights: int = 21
    predicted: int = 22
    predicted_cov: int = 23
    log_below: int = 24
    log_above: int = 25
    tape: int = 26
    theta_bar: int = 27
    normals: int = 28
    state: int = 29


@known_when_compiled
class HeaderSlots(NamedTuple):
    """The head of every plan; nothing else of it is read unless this is right."""

    n_words: int = 0
    stamp: int = 1  # of the length and the version of the layout
    checksum: int = 2  # of all words behind it
    run: int = 3  # the function to call


RECORD, REQUEST, RESULTS, HEADER = RecordSlots(), RequestSlots(), ResultSlots(), HeaderSlots()
N_RECORD, N_REQUEST, N_RESULTS, N_HEADER = map(len, (RECORD, REQUEST, RESULTS, HEADER))

HEALTH_SIZE = 3

SHAPES: Mapping[str, tuple[str | int, ...]] = {
    "terms": ("n_points", "n_terms"),
    "health": ("n_points", HEALTH_SIZE),
    "n_effective": ("n_terms",),
    "mean": ("n_wanted", "n_states"),
    "sd": ("n_wanted", "n_states"),
    "cov": ("n_wanted", "n_states", "n_states"),
    "drawn": ("n_wanted", "n_states"),
    "n_effective_wanted": ("n_wanted",),
    "members": ("n_wanted", "n_members", "n_states"),
    "weights": ("n_wanted", "n_members"),
    "predicted": ("n_terms", "n_observables"),
    "predicted_cov": ("n_terms", "n_observables", "n_observables"),
    "log_below": ("n_terms", "n_observables"),
    "log_above": ("n_terms", "n_observables"),
    "tape": ("n_tape", "tape_width"),
    "theta_bar": ("n_records", "n_theta"),
    "normals": ("n_normals",),
    "state": ("n_points", "n_state"),
}
"""Shapes of the results; a caller that wants fewer dimensions leaves out the first."""


class Argument(NamedTuple):
    """Where an argument goes: the vector, the slot of its value or address, those of its shape."""

    vector: str
    slot: int
    shape: tuple[int, ...] = ()
    is_value: bool = False


def _value(slot: int) -> Argument:
    return Argument("request", slot, is_value=True)


ARGUMENTS: Mapping[tuple[str, int], Argument] = {
    ("theta", 1): Argument("record", RECORD.theta, (RECORD.n_theta,)),
    ("theta", 2): Argument("record", RECORD.theta, (RECORD.n_records, RECORD.n_theta)),
    ("steps", 1): Argument("record", RECORD.rows, (RECORD.n_rows,)),
    ("steps", 2): Argument("record", RECORD.rows, (RECORD.n_rows, RECORD.row_width)),
    ("observed", 2): Argument("record", RECORD.observed, (RECORD.n_observed, RECORD.n_observables)),
    ("inputs", 2): Argument("record", RECORD.inputs, (RECORD.n_input_rows, RECORD.n_inputs)),
    ("t0", 0): Argument("record", RECORD.starts),
    ("seed", 0): _value(REQUEST.seed),
    ("normals", 1): Argument("request", REQUEST.normals, (REQUEST.n_normals,)),
    ("wanted", 1): Argument("request", REQUEST.wanted, (REQUEST.n_wanted,)),
    ("draw_seed", 0): _value(REQUEST.draw_seed),
    ("terms_bar", 1): Argument("request", REQUEST.terms_bar, (REQUEST.n_terms_bar,)),
    ("state", 1): Argument("request", REQUEST.state, (REQUEST.n_state,)),
    ("state", 2): Argument("request", REQUEST.state, (REQUEST.n_before, REQUEST.n_state)),
    ("tape", 2): Argument("request", REQUEST.tape, (REQUEST.n_tape, REQUEST.tape_width)),
    ("rank", 0): _value(REQUEST.rank),
    ("n_ranks", 0): _value(REQUEST.n_ranks),
    ("exchange", 0): _value(REQUEST.exchange),
    ("number", 0): _value(REQUEST.number),
    ("replacement", 0): _value(REQUEST.replacement),
}
"""By the name and the number of dimensions of an argument."""

DEFAULTS = {
    "record": {RECORD.n_records: 1, RECORD.row_width: 1, RECORD.n_starts: 1},
    "request": {REQUEST.n_ranks: 1, REQUEST.n_before: 1},
}
"""Words that are not 0 where nothing is given."""


class Refusal(OutcomeCode):
    """Why a call was refused: its status."""

    DAMAGED = 1, "the plan of a compiled filter is damaged: its memory was overwritten"
    STEPS = 2, "steps must not be negative and must increase strictly"
    INPUT_COLUMNS = 3, "inputs must have one column for each input of the system"
    INPUT_ROWS = 4, "inputs has too few rows: row k holds during step k"
    OBSERVED = (
        5,
        "observed must have a row for each step and a column for each observable; for a record of "
        "another length give the variable steps and observed as pm.Data with dims=(..., ...), as "
        "StateSpace says, and replace both in one pm.set_data",
    )
    PANEL_COLUMNS = 6, "the rows of a panel must have a column each for record, step, inputs"
    PANEL_STEPS = 7, "steps must not be negative and must increase strictly within a record"
    PANEL_RECORDS = (
        8,
        "the parameters must have a row for each record of the panel; for another number of "
        "records replace the parameters' dimension too",
    )
    NORMALS = 9, "normals must be those of this filter, system and steps"
    RAISED = 10, "the callback of a likelihood raised an error"
    STATE = (
        11,
        "the state of the filter must be one that it left after earlier rows of this record",
    )


(
    DAMAGED, STEPS, INPUT_COLUMNS, INPUT_ROWS, OBSERVED, PANEL_COLUMNS, PANEL_STEPS, PANEL_RECORDS,
    NORMALS, RAISED, STATE,
) = map(int, Refusal)  # fmt: skip

PLAN_ARGUMENTS = {"plan": I64_PTR, "record": I64_PTR, "request": I64_PTR, "results": I64_PTR}

_FACTOR, _MASK = 0x9E3779B97F4A7C15, 2**64 - 1


def version_of(*layouts: tuple) -> int:
    """A number that another layout of the same vectors does not have."""
    names = repr([*layouts, RECORD, REQUEST, RESULTS, HEADER])
    return int.from_bytes(hashlib.sha256(names.encode()).digest()[:7])


def plan_entry(
    function: Callable,
    name: str,
    parts: Sequence[str | Callable | None] = (),
    needs: Sequence[EntryPoint] = (),
) -> EntryPoint:
    """An entry point that is called with a plan, a record, a request and results."""
    return EntryPoint(function, PLAN_ARGUMENTS, name, parts, needs, returns=types.int64)


@njit_internal
def checksum(words):
    """A number that depends on every word behind the checksum, and on its place."""
    total = np.uint64(0)
    for i in range(HEADER.checksum + 1, words.size):
        total = (total ^ np.uint64(words[i])) * np.uint64(_FACTOR)
        total ^= total >> np.uint64(29)
    return np.int64(total)


@njit_internal
def plan_words(plan, version):
    """The words of a plan of this version; none if it is damaged.

    Its length is read only if the version and the length agree with their common stamp.
    """
    head = carray(plan, (N_HEADER,))
    n_words = head[HEADER.n_words]
    stamp = np.uint64(version) ^ (np.uint64(n_words) * np.uint64(_FACTOR))
    if head[HEADER.stamp] != np.int64(stamp):
        return head[:0]
    words = carray(plan, (n_words,))
    return words if checksum(words) == head[HEADER.checksum] else head[:0]


class Plan:
    """A plan, and the symbol by which graphs refer to it; its words are filled in on first use.

    It is given without the header and the addresses, with the version of its layout (see
    `version_of`), the function to run, and those whose addresses belong to these slots. The key
    identifies functions, sizes and settings, in any process; it is None if one of them cannot be
    cached on disk.
    """

    def __init__(
        self,
        words: np.ndarray,
        version: int,
        run: EntryPoint,
        functions: Mapping[int, EntryPoint],
        key: str | None,
    ) -> None:
        self._words, self._version = words, version
        self._functions = {**functions, HEADER.run: run}
        self.key = key
        self._symbol = f"psf_plan_{key or uuid4().hex}"

    @cached_property
    def address(self) -> int:
        """Address of the words; functions are compiled, and the symbol is defined."""
        words = self._words.copy()
        for slot, entry in self._functions.items():
            entry.compile()
            words[slot] = entry.address
        words[HEADER.n_words] = words.size
        words[HEADER.stamp] = _signed(self._version ^ (words.size * _FACTOR & _MASK))
        words[HEADER.checksum] = _signed(_checksum(words))
        # Compiled graphs refer to the words for the life of the process, as do other plans of this
        # key: those of equal code, which may be of another operation or of another system.
        words = _kept.setdefault(self._symbol, words)
        llvm.add_symbol(self._symbol, words.ctypes.data)
        return words.ctypes.data

    @property
    def is_compiled(self) -> bool:
        """Whether the function to call, which knows nothing of a system, needs no compilation."""
        return self._functions[HEADER.run].is_compiled

    def load(self) -> None:
        """Compile the functions, or load them from disk, and define the symbol."""
        _ = self.address

    @property
    def symbol(self) -> str:
        """The name of the words in machine code, defined in this process."""
        return self._symbol if self.address else ""

    @cached_property
    def run(self) -> Callable[..., int]:
        """The function to call, with four addresses."""
        return PlanFunction(self._functions[HEADER.run].address if self.address else 0)


_kept: dict[str, np.ndarray] = {}

PlanFunction = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_void_p] * 4)
"""The type of a function of a plan; called from Python it releases the GIL."""


def _signed(number: int) -> int:
    return number - 2**64 if number >= 2**63 else number


def _checksum(words: np.ndarray) -> int:
    total = 0
    for word in words[HEADER.checksum + 1 :].tolist():
        total = ((total ^ (word & _MASK)) * _FACTOR) & _MASK
        total ^= total >> 29
    return total
