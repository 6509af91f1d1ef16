"""The limit of a measurement in seconds, and its progress."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class OutOfTimeError(Exception):
    """The limit has been reached."""


class Effort:
    """Evaluations made so far, which are reported to ``on_progress``, and a limit in seconds.

    Compilation does not count.
    """

    def __init__(self, max_seconds: float):
        self._deadline, self._max_seconds = time.monotonic() + max_seconds, max_seconds
        self.is_limited = False  # not before there is a result
        self.on_progress: Callable[[int], None] = lambda count: None
        self.announce: Callable[[str, int], None] = lambda task, total: None

    def has_left(self, fraction: float) -> bool:
        """Whether less than this fraction of the limit has passed."""
        return self._deadline - time.monotonic() > (1.0 - fraction) * self._max_seconds

    def advance(self, count: int) -> None:
        """Report evaluations; raise `OutOfTimeError` at the limit."""
        self.on_progress(count)
        if self.is_limited and not self.has_left(1.0):
            raise OutOfTimeError

    @contextmanager
    def compilation(self, what: str) -> Iterator[None]:
        """Announce a compilation, and do not count its time."""
        self.begin_compilation(what)
        yield
        self.end_compilation()

    def begin_compilation(self, what: str) -> None:
        """Announce it."""
        self.announce(f"Compiling {what}", 1)
        self._compiling_since = time.monotonic()

    def end_compilation(self) -> None:
        """Do not count its time."""
        self._deadline += time.monotonic() - self._compiling_since
        self.on_progress(1)
