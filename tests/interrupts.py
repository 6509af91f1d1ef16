"""Ctrl-C by a test, in its own process."""

import contextlib
import os
import signal
import threading

import pytest

# The next interrupt comes so late that the one before has been raised and noticed by then.
AGAIN_SECONDS = 5.0
MOST = 5


def interrupt():
    """Interrupt this process; on Windows os.kill would end it."""
    if os.name == "nt":
        signal.raise_signal(signal.SIGINT)
    else:
        os.kill(os.getpid(), signal.SIGINT)


def interrupt_in(seconds):
    """A started timer that interrupts."""
    timer = threading.Timer(seconds, interrupt)
    timer.start()
    return timer


def repeat_until_interrupted(call, seconds):
    """Repeat a call until an interrupt, sent after so many seconds, ends it; how many it took.

    Python discards what the callback of a weak reference or of the garbage collector raises, so
    one that arrives there is lost, and another is sent.
    """
    sent, begun, raised = [], threading.Event(), threading.Event()

    def send():
        begun.wait()
        wait = seconds
        while len(sent) < MOST and not raised.wait(wait):
            sent.append(wait)
            interrupt()
            wait = AGAIN_SECONDS
        raised.wait(AGAIN_SECONDS)  # for the last one

    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    try:
        with pytest.raises(KeyboardInterrupt):  # noqa: PT012
            begun.set()
            while sender.is_alive():
                call()
    finally:
        # On a busy machine a further one was sent before the first was raised.
        for _ in range(2):
            with contextlib.suppress(KeyboardInterrupt):
                raised.set()
                sender.join()
    return len(sent)
