"""Ctrl-C where an exception at any moment would do harm: among ranks that wait for each other."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, current_thread, main_thread
from typing import Any


@contextmanager
def noticed_interrupts() -> Iterator[Event]:
    """Set an event at an interrupt, and go on.

    Python would raise between any two steps: after a message was taken, and before what it says is
    done. Outside of the main thread nothing is ever interrupted.
    """
    interrupted = Event()

    def notice(*_: Any) -> None:
        interrupted.set()

    with _handled_by(notice):
        yield interrupted


@contextmanager
def interrupts_left_to_another_rank() -> Iterator[None]:
    """Go on at an interrupt: it may reach all ranks, and one of them tells the others to stop."""
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
