"""A planned function as what `rows.Rows` evaluates at many points in threads, without a graph."""

from collections.abc import Callable, Sequence

import numpy as np
from numba import carray

from .composed_call import WORD, Copy, call_plan, words_at
from .entry_point import F64_PTR, I64_PTR, EntryPoint, pointer
from .planned_function import BoundCall, PlannedFunction
from .pytensor_function import Call

_N_HEAD = 5  # adapter, plan, record, number of copies, number of results


def _run(table, out):
    """Copy what is passed by value, call the plan, and write its results one after the other."""
    head = carray(table, (_N_HEAD,))
    plan, record, n_copies, n_results = head[1], head[2], head[3], head[4]
    words = carray(table, (_N_HEAD + 2 * n_copies + 2 * n_results,))
    place = _N_HEAD
    for _ in range(n_copies):
        words_at(words[place + 1], 1)[0] = words_at(words[place], 1)[0]
        place += 2
    status = call_plan(plan, record)
    size = 1
    for i in range(n_results):
        size += words[place + 2 * i + 1]
    numbers = carray(out, (size,))
    numbers[0] = float(status)
    if status:
        return
    k = 1
    for _ in range(n_results):
        for number in carray(pointer(words[place]), (words[place + 1],), np.float64):
            numbers[k] = number
            k += 1
        place += 2


_RUN = EntryPoint(_run, {"table": I64_PTR, "out": F64_PTR}, "planned_row")


class PlannedRow:
    """A planned function whose arguments come in another order, with some of its results.

    It has the attributes and methods of `pytensor_function.NativeFunction`. ``order`` has the
    numbers of the arguments, those first that differ from row to row; ``example`` is a first call
    in this order, and ``kept`` the numbers of the results that are wanted.
    """

    is_native = True

    def __init__(
        self,
        function: PlannedFunction,
        order: Sequence[int],
        example: Sequence[np.ndarray],
        kept: Sequence[int],
    ) -> None:
        self._function, self._order, self._kept = function, list(order), list(kept)
        self.example = [np.require(value, requirements=("C", "W")) for value in example]
        results = self._bound(self.example).results
        self.kinds = [(results[i].shape, results[i].dtype) for i in self._kept]

    @property
    def size(self) -> int:
        """Total number of elements of the results."""
        return sum(int(np.prod(shape)) for shape, _ in self.kinds)

    def _in_turn(self, inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Inputs in the order of the planned function."""
        found = [np.empty(0)] * len(inputs)
        for place, value in zip(self._order, inputs, strict=True):
            found[place] = value
        return found

    def _bound(self, inputs: Sequence[np.ndarray]) -> BoundCall:
        return self._function.bound(*self._in_turn(inputs))

    def __call__(self, *inputs: np.ndarray) -> Sequence[np.ndarray]:
        """Call from Python."""
        results = self._function(*self._in_turn(inputs))
        return [results[i] for i in self._kept]

    def bind(self, inputs: Sequence[np.ndarray]) -> tuple[Call, Callable[[], object]]:
        """A call that reads these arrays, and a function that repeats it from Python."""
        _RUN.compile()
        bound = self._bound(inputs)
        record = bound.words.buffer_info()[0]
        given = self._in_turn(inputs)
        copies = [
            Copy(value.ctypes.data, record + WORD * place)
            for value, place in zip(given, bound.places, strict=True)
            if place is not None
        ]
        results = [bound.results[i] for i in self._kept]
        words = [_RUN.address, bound.plan, record, len(copies), len(results)]
        for copy in copies:
            words += copy
        for result in results:
            words += result.ctypes.data, result.size
        call = Call(np.array(words, dtype=np.int64), np.zeros(1 + self.size))
        return call, lambda _memory=bound: self(*inputs)
