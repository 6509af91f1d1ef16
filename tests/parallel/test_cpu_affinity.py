"""Processors of a computer on which several processes run."""

import os

import pytest

from pymc_statespace_filters.parallel.cpu_affinity import (
    allowed_cores,
    available_cores,
    cores_per_process,
)


def test_this_process():
    assert available_cores() == len(allowed_cores()) >= 1
    if hasattr(os, "sched_getaffinity"):
        assert allowed_cores() == os.sched_getaffinity(0)


@pytest.mark.parametrize(
    ("used", "shares"),
    [
        ([{0, 1, 2, 3}], [4]),
        ([{0, 1}] * 2, [1, 1]),  # free to use both
        ([{0}, {1}], [1, 1]),  # each bound to one
        ([{0, 1, 2, 3}, {4, 5, 6, 7}], [4, 4]),  # each bound to some
        ([{0, 1, 2, 3}] * 2 + [{4, 5, 6, 7}] * 2, [2] * 4),  # to a socket
        ([set(range(6))] * 3, [2] * 3),  # thirds add up
        ([{0, 1}] * 4, [1] * 4),  # more processes than processors
    ],
)
def test_shares(used, shares):
    assert [cores_per_process(i, used) for i in range(len(used))] == shares
