"""Time that passes only when a lease is waited for, and leases of other computers."""

import re
from contextlib import contextmanager

from pymc_statespace_filters.sampling.checkpoint import lease


class Clock:
    """What passes while a lease is watched; functions can run at each poll."""

    def __init__(self):
        self.now = 0.0
        self.at_each_sleep = []

    def sleep(self, seconds):
        self.now += seconds
        for function in self.at_each_sleep:
            function()


def lease_file(folder, pid, host="node7", start=345, name="lease.0"):
    """The file of a process that has ended without removing it."""
    path = folder / name
    path.write_text(
        f"filelock/2\npid={pid}\nhost={host}\nmode=lease\ntoken=0\nduration=20.0\nstart={start}\n"
    )
    return path


@contextmanager
def lease_of_elsewhere(monkeypatch, folder, host="node7"):
    """A lease that a process of another computer holds, without a heartbeat for a while."""
    with monkeypatch.context() as other:
        other.setattr(lease, "_HEARTBEAT_SECONDS", 19.0)
        other.setattr(lease, "_process_table", lambda: f"of {host}")
        held = lease.FolderLease(folder)
    held.path.write_text(re.sub("host=.*", f"host={host}", held.path.read_text()))
    yield held
    held.release()
