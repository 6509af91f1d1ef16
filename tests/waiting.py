"""Waits that end."""

import signal
import subprocess
import sys
import time
from contextlib import contextmanager

# Seconds for a test, and for all that it waits for; no test is meant to come near it. pytest ends
# the whole process after 600: where machine code does not return, or there is no such signal.
LIMIT = 500.0


def _fail(*_):
    raise AssertionError(f"still running after {LIMIT:g} s")


@contextmanager
def limited():
    """Let the block fail that takes longer, whatever it waits for."""
    if not hasattr(signal, "SIGALRM"):
        yield
        return
    before = signal.signal(signal.SIGALRM, _fail)
    signal.setitimer(signal.ITIMER_REAL, LIMIT)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def wait_until(condition):
    """Poll until a condition holds; it is an error if it does not in time."""
    end = time.monotonic() + LIMIT
    while not condition():
        assert time.monotonic() < end, f"still not so after {LIMIT:g} s"
        time.sleep(0.001)


@contextmanager
def python(*arguments):
    """A process of Python whose output is read, and that does not outlast the block."""
    command = [sys.executable, *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        try:
            yield child
        finally:
            child.kill()
