"""Work in threads that a terminal can follow and Ctrl-C ends."""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from functools import partial
from threading import Event
from time import thread_time

import numpy as np

from .cpu_affinity import available_cores

_REFRESH_SECONDS = 0.1
_SHORT = 2e-3  # seconds; threads take a part of that to start and end


class Pace:
    """How many seconds a unit of some work takes a processor, by the last times.

    A time counts half at the next one, if that is shorter: points that fail at once say little.
    """

    def __init__(self) -> None:
        self._seconds: float | None = None

    def is_short(self, work: float) -> bool:
        """Whether several threads would hardly do so much work any sooner."""
        return self._seconds is not None and work * self._seconds < _SHORT

    def n_parts(self, work: float, seconds: float, *, at_least: int) -> int:
        """The number of parts of so much work that take so many seconds each, or fewer."""
        return max(at_least, math.ceil(work * (self._seconds or 0.0) / seconds))

    def measured(self, work: float, seconds: float) -> None:
        """Note that so much work has taken so many seconds."""
        self._seconds = max(seconds / max(work, 1), 0.5 * (self._seconds or 0.0))


def run_in_threads(
    parts: Sequence[Callable[[], None]],
    n_threads: int,
    *,
    n_done: Callable[[], int],
    stop: Callable[[], None],
    on_progress: Callable[[int], None],
) -> float:
    """Run parts of some work, and raise what a part raises; the seconds that processors took.

    ``on_progress`` is called in this thread with what ``n_done`` has grown by. ``stop`` asks parts
    that are still running to end, after an error or an interrupt.
    """
    n_reported, seconds = 0, 0.0
    with ThreadPoolExecutor(n_threads) as pool:
        pending = {pool.submit(timed, part) for part in parts}
        try:
            while pending:
                done, pending = wait(pending, _REFRESH_SECONDS, return_when=FIRST_EXCEPTION)
                for future in done:
                    seconds += future.result()
                now = n_done()
                on_progress(now - n_reported)
                n_reported = now
        finally:
            stop()
    return seconds


def timed(part: Callable[[], None]) -> float:
    """The seconds that some work takes the processor of this thread."""
    began = thread_time()
    part()
    return thread_time() - began


class Pieces:
    """Results of a function at many points, in pieces of so many ``seconds`` that threads share.

    A piece has a multiple of ``at_once`` points. An interrupt waits for the pieces that run.
    """

    def __init__(self, seconds: float, at_once: int) -> None:
        self._seconds, self._at_once, self._pace = seconds, at_once, Pace()

    def __call__(
        self, evaluate: Callable[[slice], Sequence[np.ndarray]], points: slice, work: float
    ) -> list[np.ndarray]:
        """The results, one below the other, of a function of a slice of the points.

        The time of all is roughly proportional to ``work``.
        """
        m, n_threads = points.stop - points.start, available_cores()
        n_pieces = self._pace.n_parts(work, self._seconds, at_least=n_threads)
        size = -(-m // (n_pieces * self._at_once)) * self._at_once
        if m <= size or self._pace.is_short(work):
            size = max(m, 1)
        firsts = range(points.start, max(points.stop, points.start + 1), size)
        pieces = [slice(first, min(first + size, points.stop)) for first in firsts]
        found: list[Sequence[np.ndarray]] = [()] * len(pieces)
        stopped = Event()

        def run(number: int) -> None:
            if not stopped.is_set():
                found[number] = evaluate(pieces[number])

        if len(pieces) == 1:
            seconds = timed(partial(run, 0))
        else:
            seconds = run_in_threads(
                [partial(run, number) for number in range(len(pieces))],
                n_threads,
                n_done=lambda: 0,
                stop=stopped.set,
                on_progress=lambda count: None,
            )
        self._pace.measured(work, seconds)
        return [np.concatenate(parts) for parts in zip(*found, strict=True)]
