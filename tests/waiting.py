"""Waits that end."""

import time

LIMIT = 500.0  # seconds for another process; pytest ends this one after 600, and would leave it


def wait_until(condition, seconds=120.0):
    """Poll until a condition holds; it is an error if it does not in time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"still not so after {seconds:g} s"
        time.sleep(0.001)
