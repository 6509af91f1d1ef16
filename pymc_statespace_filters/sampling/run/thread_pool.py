"""The threads of one process that run its chains."""

import time
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from threading import Event
from typing import Self

import numpy as np

from .chain_task import ChainTask

_REFRESH_SECONDS = 0.1


class ChainPool:
    """Threads that run chains; a context manager that stops them all on exit.

    All methods are called from one thread, the one that may be interrupted. ``running`` has the
    chains that run, wait for a thread, or were stopped, by number; ``ended`` is for chains that may
    go on.
    """

    def __init__(self, n_threads: int):
        self._n_threads = n_threads
        self._pool = ThreadPoolExecutor(n_threads)
        self._stop = Event()
        self._futures: dict[Future, int] = {}
        self.running: dict[int, ChainTask] = {}
        self.ended: dict[int, ChainTask] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._pool.shutdown()

    @property
    def is_idle(self) -> bool:
        """Whether a thread is idle."""
        return len(self.running) < self._n_threads

    def start(self, number: int, task: ChainTask) -> None:
        """Run a chain in an idle thread."""
        self.running[number] = task
        self._futures[self._pool.submit(task.run, self._stop)] = number

    def go_on(self, number: int, goal: tuple[int, int, np.ndarray] | None) -> None:
        """Run an ended chain again, as soon as a thread is idle; with None release it.

        The goal is as the arguments of `ChainTask.extend`.
        """
        task = self.ended.pop(number)
        if goal is not None:
            task.extend(*goal)
            self.start(number, task)

    def finished(self, seconds: float = _REFRESH_SECONDS) -> Sequence[tuple[int, ChainTask]]:
        """Wait for chains to finish, for at most so many seconds, and remove those that have.

        Raises what a model raised, with a note that names the chain.
        """
        if not self._futures:
            time.sleep(seconds)
        done, _ = wait(self._futures, seconds, return_when=FIRST_COMPLETED)
        for future in done:
            future.result()
        numbers = [self._futures.pop(future) for future in done]
        for task in self.running.values():
            task.request_pause(self._stop)
        return [(number, self.running.pop(number)) for number in numbers]

    def stop(self) -> None:
        """Stop all chains and wait for them."""
        self._stop.set()
        unfinished = set(self._futures)
        while unfinished:
            for task in self.running.values():
                task.request_pause(self._stop)
            _, unfinished = wait(unfinished, timeout=_REFRESH_SECONDS)
        self._futures.clear()
