"""The chains that one process runs at a time, in threads."""

import time
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from threading import Event
from typing import NamedTuple, Self

from pymc_statespace_filters.sampling.run.chain_task import ChainRun

_REFRESH_SECONDS = 0.1


class Job(NamedTuple):
    """A chain of one of several models, by their numbers."""

    model: int
    chain: int


class Crew:
    """Threads that run chains; a context manager, after which none of them runs any more.

    All methods are called from one thread, the one that may be interrupted.

    Parameters
    ----------
    n_threads : int

    Attributes
    ----------
    at_work : dict of Job to ChainRun
        The chains that run, and those that were halted.
    """

    def __init__(self, n_threads: int):
        self._n_threads = n_threads
        self._pool = ThreadPoolExecutor(n_threads)
        self._stop = Event()
        self._futures: dict[Future, Job] = {}
        self.at_work: dict[Job, ChainRun] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.halt()
        self._pool.shutdown()

    @property
    def has_room(self) -> bool:
        """Whether a thread is free."""
        return len(self.at_work) < self._n_threads

    def start(self, job: Job, run: ChainRun) -> None:
        """Let a free thread run a chain."""
        self.at_work[job] = run
        self._futures[self._pool.submit(run.run, self._stop)] = job

    def ended(self, seconds: float = _REFRESH_SECONDS) -> Sequence[tuple[Job, ChainRun]]:
        """Wait so long at most for chains to end, and hand out those that have.

        Raises
        ------
        Exception
            What a model raised, with a note that names the chain.
        """
        if not self._futures:
            time.sleep(seconds)
        ended, _ = wait(self._futures, seconds, return_when=FIRST_COMPLETED)
        for future in ended:
            future.result()
        jobs = [self._futures.pop(future) for future in ended]
        for run in self.at_work.values():
            run.ask_for_pause(self._stop)
        return [(job, self.at_work.pop(job)) for job in jobs]

    def halt(self) -> None:
        """Bring all chains to a halt, however often the user interrupts meanwhile."""
        self._stop.set()
        running = set(self._futures)
        while running:
            with suppress(KeyboardInterrupt):
                for run in self.at_work.values():
                    run.ask_for_pause(self._stop)
                _, running = wait(running, timeout=_REFRESH_SECONDS)
        self._futures.clear()
