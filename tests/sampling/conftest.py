"""What several tests of sampling share."""

import pytest

from pymc_statespace_filters.sampling.checkpoint import lease
from tests.sampling.lease_clock import Clock


@pytest.fixture
def clock(monkeypatch):
    """Time that passes only while a lease is watched."""
    clock = Clock()
    monkeypatch.setattr(lease, "sleep", clock.sleep)
    return clock
