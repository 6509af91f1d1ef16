"""Progress of rows and stages, and what is said while machine code is compiled."""

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from threading import Timer
from time import perf_counter
from typing import Any, Protocol

from rich.console import Console

PATIENCE = 2.0  # seconds without a progress bar


class _RowProgress:
    """A bar that appears when its task has taken some seconds; the next task begins a new one."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._total = self._done = 0
        self._shown: tuple | None = None
        self.begin("", 0)

    def begin(self, task: str, total: int) -> None:
        """Name the next task and about how many rows it has."""
        if self._shown is not None:  # the total was an estimate
            bar, row = self._shown
            bar.advance(row, advance=max(0, self._total - self._done))
        self._stack.close()
        self._task, self._total = task, total
        self._done, self._start = 0, perf_counter()
        self._shown = None

    def advance(self, count: int) -> None:
        self._done += count
        if self._shown is not None:
            bar, row = self._shown
            bar.advance(row, advance=count)
        elif perf_counter() - self._start > PATIENCE:
            self._show()

    def _show(self) -> None:
        bar = self._stack.enter_context(_bar())
        self._shown = bar, bar.add_task(self._task, completed=self._done, total=self._total)


class ReportsRows(Protocol):
    """Work that calls ``on_progress``, in the main thread, with the number of new rows."""

    on_progress: Callable[[int], None]


@contextmanager
def row_progress(work: ReportsRows, *, enabled: bool) -> Iterator[Callable[[str, int], None]]:
    """Show the progress of work that takes longer than `PATIENCE` seconds.

    Yields the function that begins a task, with its name and about how many rows it has.
    """
    before = work.on_progress
    with ExitStack() as stack:
        bar = _RowProgress(stack)
        if enabled:
            work.on_progress = bar.advance
        try:
            yield bar.begin if enabled else lambda task, total: None
        finally:
            work.on_progress = before  # what it does after the last task has no bar
        bar.begin("", 0)  # the last task is done


@contextmanager
def stage_progress(total: float, *, enabled: bool) -> Iterator[Callable[[float, str], None]]:
    """Show the stages of work that takes longer than `PATIENCE`.

    Yields the function that says how much of the total is done, and what the last stage was.
    """
    start, shown = perf_counter(), None
    with ExitStack() as stack:

        def show(done: float, text: str) -> None:
            nonlocal shown
            if not enabled or perf_counter() - start < PATIENCE:
                return
            if shown is None:
                bar = stack.enter_context(_bar())
                shown = bar, bar.add_task(text, total=total)
            bar, row = shown
            bar.update(row, description=text, completed=done)

        yield show


@contextmanager
def _bar() -> Iterator[Any]:
    """PyMC's bar, which is shown after seconds: who calls filters alone need not import PyMC."""
    from pymc.progress_bar import create_simple_progress

    with create_simple_progress() as bar, _quiet_compilation():
        yield bar


_shown: list[object] = []  # bars, and lines that may be


@contextmanager
def _quiet_compilation() -> Iterator[None]:
    """Show no line about compilation, which would be drawn over what is shown now."""
    _shown.append(object())
    try:
        yield
    finally:
        _shown.pop()


@contextmanager
def slow_compilation(name: str) -> Iterator[None]:
    """Say what is being compiled, if it takes longer than `PATIENCE`.

    The line in a terminal disappears when the compilation ends. Without a terminal PyMC's logger
    has a line, one in a process.
    """
    console = Console(stderr=True)
    if _shown:
        yield
        return
    text = f"Compiling {name}, once per installation ..."
    status = console.status(text) if console.is_terminal else None
    timer = Timer(PATIENCE, status.start if status else partial(_log_first, text))
    timer.daemon = True
    timer.start()
    try:
        with _quiet_compilation():  # of parts
            yield
    finally:
        timer.cancel()
        timer.join()
        if status:
            status.stop()


_logged: list[str] = []


def _log_first(text: str) -> None:
    if not _logged:
        _logged.append(text)
        logging.getLogger("pymc").info(text)
