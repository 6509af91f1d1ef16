"""A compiled function applied to many rows of arguments, in threads of machine code."""

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pymc_statespace_filters.compiler.native.entry_point import njit_cached
from pymc_statespace_filters.compiler.native.pytensor_function import NativeFunction, make_call
from pymc_statespace_filters.parallel.cpu_affinity import available_cores
from pymc_statespace_filters.parallel.signals import held_interrupts

_REFRESH_SECONDS = 0.1
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


class ParallelMap:
    """A compiled PyTensor function of float64 and int64 arguments, applied to many points.

    ``varying`` holds an example of each of its first arguments, which differ from row to row;
    ``constant`` holds the others, and ``shapes`` the shapes of the results. Results depend neither
    on the order of the points nor on the number of threads. ``on_progress`` is called in the main
    thread with the number of rows done since its last call.
    """

    def __init__(
        self, function: Any, varying: Sequence[np.ndarray], constant: Sequence[np.ndarray] = ()
    ) -> None:
        self._examples = [np.array(value, order="C") for value in varying]
        self._constant = [np.array(value, order="C") for value in constant]
        self._native = NativeFunction(function, [*self._examples, *self._constant])
        self.shapes = self._native.shapes
        self.on_progress: Callable[[int], None] = lambda count: None

    def __call__(self, *columns: np.ndarray) -> NDArray[np.float64]:
        """Results of every row, flattened and joined, (m, size); NaN for rows not reached.

        ``columns`` are the varying arguments, each with a first dimension of length m.
        """
        rows = self._words(columns)
        results = np.full((len(rows), self._native.size), np.nan)
        n_threads = min(available_cores(), max(1, len(rows)))
        ends = np.linspace(0, len(rows), n_threads + 1).astype(int)
        control = np.zeros((n_threads, 2), dtype=np.int64)
        if len(rows) == 1:  # as in a search; a thread would take a millisecond
            with held_interrupts():
                self._call_part(rows, results, control[0])
            self.on_progress(1)
            return results
        parts = [slice(*ends[i : i + 2]) for i in range(n_threads)]
        with ThreadPoolExecutor(n_threads) as pool:
            futures = [
                pool.submit(self._call_part, rows[part], results[part], control[i])
                for i, part in enumerate(parts)
            ]
            try:
                self._wait(futures, control)
            finally:
                control[:, _STOP] = True
        return results

    def _words(self, columns: Sequence[np.ndarray]) -> NDArray[np.int64]:
        """The arguments of each row, of either type, as words of eight bytes."""
        parts = [
            np.ascontiguousarray(column, example.dtype)
            .reshape(len(column), example.size)
            .view(np.int64)
            for column, example in zip(columns, self._examples, strict=True)
        ]
        return np.ascontiguousarray(np.concatenate(parts, axis=1))

    def _call_part(
        self, rows: NDArray[np.int64], results: NDArray[np.float64], control: NDArray[np.int64]
    ) -> None:
        argument, arguments = self._allocate_arguments()
        call, kept_alive = self._native.bind(arguments)
        if not _call_rows(call, argument, rows, results, control):
            self._native(*arguments)  # raises the exception of the machine code
        del kept_alive

    def _allocate_arguments(self) -> tuple[NDArray[np.int64], list[np.ndarray]]:
        """A vector of words, and all arguments; the varying ones are views of the vector."""
        argument = np.concatenate([np.ravel(value).view(np.int64) for value in self._examples])
        arguments, start = [], 0
        for value in self._examples:
            words = argument[start : start + value.size]
            arguments.append(words.view(value.dtype).reshape(value.shape))
            start += value.size
        return argument, [*arguments, *self._constant]

    def _wait(self, futures: Sequence[Future], control: NDArray[np.int64]) -> None:
        n_reported, pending = 0, set(futures)
        while pending:
            done, pending = wait(pending, _REFRESH_SECONDS, return_when=FIRST_EXCEPTION)
            for future in done:
                future.result()
            n_done = int(control[:, _N_DONE].sum())
            self.on_progress(n_done - n_reported)
            n_reported = n_done
