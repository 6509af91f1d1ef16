"""A progress bar for work that is done in threads, row by row."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from time import perf_counter
from typing import Protocol

from pymc.progress_bar import create_simple_progress

PATIENCE = 2.0  # seconds without a progress bar


class _Bar:
    """A bar that appears once its task has taken two seconds, and goes with the next task."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._total = self._done = 0
        self._shown: tuple | None = None
        self.announce("", 0)

    def announce(self, task: str, total: int) -> None:
        """Name what is evaluated next, and about how many rows that takes."""
        if self._shown is not None:  # the number was a guess: what is done is done
            bar, row = self._shown
            bar.advance(row, advance=max(0, self._total - self._done))
        self._stack.close()
        self._task, self._total = task, total
        self._done, self._start = 0, perf_counter()
        self._shown = None

    def advance(self, count: int) -> None:
        self._done += count
        if self._shown is None and perf_counter() - self._start > PATIENCE:
            bar = self._stack.enter_context(create_simple_progress())
            self._shown = bar, bar.add_task(self._task, completed=0, total=self._total)
            count = self._done
        if self._shown is not None:
            bar, row = self._shown
            bar.advance(row, advance=count)


class Watched(Protocol):
    """Work that calls ``on_progress``, in the main thread, with the number of new rows done."""

    on_progress: Callable[[int], None]


@contextmanager
def watched(work: Watched, *, enabled: bool) -> Iterator[Callable[[str, int], None]]:
    """Show how many rows were done, and for what.

    Gives the function that names what comes next and about how many rows that takes.
    """
    with ExitStack() as stack:
        bar = _Bar(stack)
        if enabled:
            work.on_progress = bar.advance
        yield bar.announce
