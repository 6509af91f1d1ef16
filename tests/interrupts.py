"""Ctrl-C by a test, in its own process."""

import os
import signal
import threading


def interrupt_in(seconds):
    """A started timer that interrupts; on Windows os.kill would end the process."""
    how = (signal.raise_signal,) if os.name == "nt" else (os.kill, os.getpid())
    timer = threading.Timer(seconds, how[0], (*how[1:], signal.SIGINT))
    timer.start()
    return timer
