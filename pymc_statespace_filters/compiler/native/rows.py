"""Functions at many rows of arguments: machine code in threads, or graphs that are interpreted."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol

import numpy as np
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.compile.mode import Mode
from pytensor.graph.basic import Variable
from pytensor.graph.replace import vectorize_graph
from pytensor.tensor.variable import TensorVariable

from ...parallel.cpu_affinity import available_cores
from ...parallel.shared_rows import evaluated_rows
from ...parallel.signals import held_interrupts
from ...parallel.threads import Pace, run_in_threads, timed
from .entry_point import njit_cached
from .pytensor_function import Call, make_call

# Control block of each thread: rows done, written by the thread; stop, written by the main thread.
_N_DONE, _STOP = 0, 1


@njit_cached
def _call_rows(call, argument, rows, results, control):
    """Call with every row of words (m, size), until stopped; False if a call raised."""
    for i in range(len(rows)):
        if control[_STOP]:
            return True
        for j in range(argument.size):
            argument[j] = rows[i, j]
        if not make_call(call):
            return False
        for j in range(results.shape[1]):
            results[i, j] = call.out[1 + j]
        control[_N_DONE] = i + 1
    return True


class RowFunction(Protocol):
    """What is evaluated at rows: a `NativeFunction`, or a `planned_rows.PlannedRow`."""

    is_native: bool
    example: list[np.ndarray]
    kinds: list[tuple[tuple[int, ...], np.dtype]]

    @property
    def size(self) -> int:
        """Total number of elements of the results."""

    def __call__(self, *inputs: np.ndarray) -> Sequence[np.ndarray]:
        """Call from Python."""
        ...

    def bind(self, inputs: Sequence[np.ndarray]) -> tuple[Call, Callable[[], object]]:
        """A call that reads these arrays, and a function that repeats it from Python."""
        ...


class Rows:
    """A function whose first ``n_varying`` arguments, float64 or int64, differ from row to row.

    The others are those of the function's example. Machine code runs in threads, by way of results
    in float64; ranks that share rows each evaluate a part, see `parallel.shared_rows`. What needs
    Python, or is asked for ``in_turn``, as all ranks share each evaluation, runs in the calling
    thread, one row after the other. Results depend neither on the order of the rows nor on the
    number of threads and ranks. ``on_progress`` is called in the main thread with the number of
    rows done since its last call.
    """

    def __init__(self, function: RowFunction, n_varying: int, *, in_turn: bool = False) -> None:
        self._function, self._in_turn = function, in_turn or not function.is_native
        self._varying = function.example[:n_varying]
        self._constant = function.example[n_varying:]
        self.on_progress: Callable[[int], None] = lambda count: None
        self._pace = Pace()
        self.is_shared = True  # by ranks; a message takes longer than a cheap function

    def __call__(self, *columns: np.ndarray) -> list[np.ndarray]:
        """Each of the results at every row, (m, ...).

        ``columns`` are the varying arguments, each with a first dimension of length m.
        """
        m = len(columns[0])
        columns = tuple(
            np.require(column, value.dtype, ("C", "W")).reshape(m, *value.shape)
            for column, value in zip(columns, self._varying, strict=True)
        )
        if not self.is_shared:
            return self._evaluated(columns)
        n_own = 0

        def evaluate(rows: slice) -> list[np.ndarray]:
            nonlocal n_own
            n_own = rows.stop - rows.start
            return self._evaluated([column[rows] for column in columns])

        found = evaluated_rows(evaluate, columns, self._empty)
        if n_own < m:
            self.on_progress(m - n_own)
        return found

    def _empty(self, m: int) -> list[np.ndarray]:
        return [np.empty((m, *shape), dtype) for shape, dtype in self._function.kinds]

    def _evaluated(self, columns: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The same by this process."""
        m = len(columns[0])
        if self._in_turn or m == 0:
            return self._one_by_one(columns, m)
        # The arguments of a row, of either type, as words of eight bytes.
        words = [column.reshape(m, -1).view(np.int64) for column in columns]
        results = self._in_threads(np.concatenate(words, axis=1))
        kinds = self._function.kinds
        ends = np.cumsum([int(np.prod(shape)) for shape, _ in kinds])[:-1]
        return [
            part.reshape(m, *shape).astype(dtype, copy=False)
            for part, (shape, dtype) in zip(np.split(results, ends, axis=1), kinds, strict=True)
        ]

    def _one_by_one(self, columns: Sequence[np.ndarray], m: int) -> list[np.ndarray]:
        results = self._empty(m)
        for i in range(m):
            values = self._function(*(column[i, ...] for column in columns), *self._constant)
            for result, value in zip(results, values, strict=True):
                result[i] = value
            self.on_progress(1)
        return results

    def _in_threads(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """The results of rows of words, (m, size); NaN for rows not reached."""
        results = np.full((len(rows), self._function.size), np.nan)
        n_threads = min(available_cores(), len(rows))
        ends = np.linspace(0, len(rows), n_threads + 1).astype(int)
        control = np.zeros((n_threads, 2), dtype=np.int64)
        if len(rows) == 1 or self._pace.is_short(len(rows)):  # as in a search
            with held_interrupts():
                seconds = timed(partial(self._call_part, rows, results, control[0]))
            self._pace.measured(len(rows), seconds)
            self.on_progress(len(rows))
            return results
        parts = [slice(*ends[i : i + 2]) for i in range(n_threads)]
        seconds = run_in_threads(
            [
                partial(self._call_part, rows[part], results[part], control[i])
                for i, part in enumerate(parts)
            ],
            n_threads,
            n_done=lambda: int(control[:, _N_DONE].sum()),
            stop=lambda: control[:, _STOP].fill(True),
            on_progress=self.on_progress,
        )
        self._pace.measured(len(rows), seconds)
        return results

    def _call_part(
        self, rows: NDArray[np.int64], results: NDArray[np.float64], control: NDArray[np.int64]
    ) -> None:
        argument = np.concatenate([np.ravel(value).view(np.int64) for value in self._varying])
        ends = np.cumsum([value.size for value in self._varying])[:-1]
        varying = [  # views of the vector of words
            part.view(value.dtype).reshape(value.shape)
            for part, value in zip(np.split(argument, ends), self._varying, strict=True)
        ]
        call, repeat = self._function.bind([*varying, *self._constant])
        if not _call_rows(call, argument, rows, results, control):
            repeat()


def at_points(
    arguments: Sequence[TensorVariable], outputs: Sequence[TensorVariable]
) -> tuple[list[TensorVariable], list[Variable]]:
    """Symbols of m points, (m, ...) for each argument, and the outputs there, each (m, ...)."""
    points = [pt.tensor(dtype=a.dtype, shape=(None, *a.type.shape)) for a in arguments]
    graphs = vectorize_graph(list(outputs), dict(zip(arguments, points, strict=True)))
    # A constant output, such as an initial mean given as numbers, has no axis of points yet.
    return points, [
        graph if graph.ndim > output.ndim else pt.alloc(graph, points[0].shape[0], *graph.shape)
        for graph, output in zip(graphs, outputs, strict=True)
    ]


def interpreted_at_points(arguments: Sequence[TensorVariable], output: TensorVariable) -> Callable:
    """The function of arrays (m, ...), one for each argument, that gives the outputs (m, ...).

    Machine code, or a simpler graph, would take longer to make than it saves in some hundred calls.
    """
    points, (graph,) = at_points(arguments, [output])
    as_it_stands = Mode(linker="py", optimizer=None)
    return pytensor.function(points, graph, mode=as_it_stands, on_unused_input="ignore")
