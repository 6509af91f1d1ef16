"""What several tests of sampling share."""

import pytest

from pymc_statespace_filters.sampling.checkpoint import lease as folder_lock
from tests.sampling.lock_clock import Clock


@pytest.fixture
def clock(monkeypatch):
    """Time that passes for locks only when they wait."""
    clock = Clock()
    monkeypatch.setattr(folder_lock, "sleep", clock.sleep)
    monkeypatch.setattr(folder_lock, "monotonic", lambda: clock.now)
    return clock
