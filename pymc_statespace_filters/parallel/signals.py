"""Handling of Ctrl-C where an exception could leave ranks waiting for each other."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, current_thread, main_thread
from typing import Any


@contextmanager
def deferred_interrupts() -> Iterator[Event]:
    """Set an event at an interrupt instead of raising.

    Python could raise between receiving a message and handling it. Threads other than the main one
    are never interrupted.
    """
    interrupted = Event()
    with _handled_by(lambda *_: interrupted.set()):
        yield interrupted


@contextmanager
def ignored_interrupts() -> Iterator[None]:
    """Ignore interrupts: they may reach all ranks, and one of them stops the others."""
    with _handled_by(signal.SIG_IGN):
        yield


@contextmanager
def _handled_by(handler: Any) -> Iterator[None]:
    if current_thread() is not main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
