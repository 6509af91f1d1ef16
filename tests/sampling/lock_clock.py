"""Time that passes only when somebody sleeps, and locks of other computers."""

from contextlib import contextmanager

from pymc_statespace_filters.sampling.checkpoint import lease as folder_lock


class Clock:
    """What locks take for the time; others can act whenever somebody sleeps."""

    def __init__(self):
        self.now = 0.0
        self.pace = 1.0
        self.at_each_sleep = []

    def sleep(self, seconds):
        self.now += seconds * self.pace
        for act in self.at_each_sleep:
            act()


@contextmanager
def lock_of_elsewhere(monkeypatch, folder, place="node7@5f2c"):
    """A lock that another computer holds; it beats when it is told to."""
    with monkeypatch.context() as other:
        other.setattr(folder_lock, "_place", lambda: place)
        lock = folder_lock.FolderLock(folder)
    yield lock
    lock.release()
