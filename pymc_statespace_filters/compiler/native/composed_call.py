"""A function composed of machine code: scalar code, calls of filters, and scalar code again.

A table of addresses describes it, so that a new composition compiles its scalar code alone:

    before(given, out)          makes the arrays that filters read
    run(plan, record, request, results)         of each filter
    sums of terms
    after(given, out)           writes whether a check failed, then the results

In front of each, words are copied to their places: what the scalar code reads, seeds, and the
length of a tape that one filter has left for another.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numba import carray

from .entry_point import F64_PTR, I64_PTR, EntryPoint, call_address, call_for_status, pointer
from .jit import njit_internal
from .plan import HEADER, N_RECORD, N_REQUEST, REQUEST
from .planned_function import BoundCall

WORD = 8  # bytes


class ScalarCall(NamedTuple):
    """Scalar code and the vectors that it reads and writes, by their addresses."""

    function: int
    given: int
    out: int = 0


class Copy(NamedTuple):
    """A word that is copied from one address to another."""

    source: int
    target: int


class Sum(NamedTuple):
    """The sum of ``n`` numbers from an address on is written to another one."""

    first: int
    n: int
    target: int


class _Head(NamedTuple):
    """The first words of a table; lists of these lengths follow."""

    run: int = 0
    status: int = 1  # of the call of a filter that was refused
    before: int = 2
    given_before: int = 3
    out_before: int = 4
    after: int = 5
    given_after: int = 6
    n_copies_before: int = 7
    n_calls: int = 8
    n_sums: int = 9
    n_copies_after: int = 10


_HEAD = _Head()
_N_HEAD = len(_HEAD)


def table_of(
    before: ScalarCall,
    after: ScalarCall,
    calls: Sequence[BoundCall],
    sums: Sequence[Sum],
    copies_before: Sequence[Copy],
    copies_after: Sequence[Copy],
    copies_between: Mapping[int, Copy] | None = None,
) -> np.ndarray:
    """The table of a composition, whose first word is the address of the function to call.

    That function takes the table and the vector of results, of which the first is 1 if a check
    failed or a call was refused. ``copies_between`` are made before the calls with these numbers.
    """
    _RUN.compile()
    words = [_RUN.address, 0, *before, after.function, after.given]
    words += map(len, (copies_before, calls, sums, copies_after))
    for copy in copies_before:
        words += copy
    for i, call in enumerate(calls):
        copy = (copies_between or {}).get(i, Copy(0, 0))
        words += call.plan, call.words.buffer_info()[0], *copy
    for each in [*sums, *copies_after]:
        words += each
    return np.array(words, dtype=np.int64)


def status_of(table: np.ndarray) -> int:
    """The status of the call of a filter that was refused, or 0."""
    return int(table[_HEAD.status])


@njit_internal
def words_at(address, count):
    """The words at an address."""
    return carray(pointer(address), (count,), np.int64)


@njit_internal
def _numbers_at(address, count):
    return carray(pointer(address), (count,), np.float64)


@njit_internal
def _copy_words(words, place, count):
    """Make the copies at a place of the table; the place behind them."""
    for _ in range(count):
        words_at(words[place + 1], 1)[0] = words_at(words[place], 1)[0]
        place += 2
    return place


@njit_internal
def call_plan(plan, record):
    """Call a filter, or what replaces it; its status."""
    request = record + WORD * N_RECORD
    replacement = words_at(request, N_REQUEST)[REQUEST.replacement]
    function = replacement if replacement else words_at(plan, HEADER.run + 1)[HEADER.run]
    return call_for_status(function, (plan, record, request, request + WORD * N_REQUEST))


@njit_internal
def _add_up(words, place):
    total = 0.0
    for number in _numbers_at(words[place], words[place + 1]):
        total += number
    _numbers_at(words[place + 2], 1)[0] = total


def _run(table, out):
    head = carray(table, (_N_HEAD,))
    n_calls, n_sums = head[_HEAD.n_calls], head[_HEAD.n_sums]
    n_copies = head[_HEAD.n_copies_before] + head[_HEAD.n_copies_after]
    words = carray(table, (_N_HEAD + 2 * n_copies + 4 * n_calls + 3 * n_sums,))
    place = _copy_words(words, _N_HEAD, head[_HEAD.n_copies_before])
    call_address(head[_HEAD.before], (head[_HEAD.given_before], head[_HEAD.out_before]))
    for _ in range(n_calls):
        if words[place + 2] != 0:
            _copy_words(words, place + 2, 1)
        status = call_plan(words[place], words[place + 1])
        if status:
            words[_HEAD.status] = status
            carray(out, (1,))[0] = 1.0
            return
        place += 4
    for _ in range(n_sums):
        _add_up(words, place)
        place += 3
    _copy_words(words, place, head[_HEAD.n_copies_after])
    call_address(head[_HEAD.after], (head[_HEAD.given_after], out))


_RUN = EntryPoint(_run, {"table": I64_PTR, "out": F64_PTR}, "composed_call")
