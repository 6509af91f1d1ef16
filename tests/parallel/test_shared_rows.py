"""Rows of a calculation that ranks share, on one rank that plays the first of two."""

import os
import signal
from types import SimpleNamespace

import numpy as np
import pytest

from pymc_statespace_filters.parallel.cpu_affinity import (
    allowed_cores,
    available_cores,
    cores_per_process,
)
from pymc_statespace_filters.parallel.shared_rows import (
    evaluated_rows,
    outlasting_interrupts,
    rows_shared_by,
)
from pymc_statespace_filters.parallel.signals import interrupts_are_noted, keeps_what_is_there

COLUMN = np.arange(5.0)


def first_of_two(shared):
    """Ranks that run a step and note which rows each of them has."""
    return SimpleNamespace(
        size=2,
        rank=0,
        run_collectively=lambda step, mark: step(),
        share_rows=lambda results, ends: shared.append(ends),
    )


def doubled(column=COLUMN):
    return evaluated_rows(lambda rows: [2 * column[rows]], [column], lambda m: [np.zeros(m)])


def test_each_rank_evaluates_its_own_rows():
    shared = []
    with rows_shared_by(first_of_two(shared)):
        (found,) = doubled()
    assert shared == [[(0, 2), (2, 5)]]
    assert found.tolist() == [0.0, 2.0, 0.0, 0.0, 0.0]  # the other rank's would come
    assert doubled()[0].tolist() == [0.0, 2.0, 4.0, 6.0, 8.0]


def test_fewer_rows_than_ranks_are_evaluated_by_each():
    shared = []
    with rows_shared_by(first_of_two(shared)):
        assert doubled(COLUMN[3:4])[0].tolist() == [6.0]
    assert not shared


def test_an_interrupt_ends_a_shared_evaluation():
    """The step tells the other ranks of it."""
    shared = []
    with rows_shared_by(first_of_two(shared)):
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            doubled()
    assert not shared


def test_what_outlasts_interrupts_is_evaluated_by_all_ranks_to_its_end():
    def work():
        signal.raise_signal(signal.SIGINT)
        return doubled()[0].tolist()

    shared = []
    with rows_shared_by(first_of_two(shared)):
        assert outlasting_interrupts(work, None) == [0.0, 2.0, 0.0, 0.0, 0.0]
        assert len(shared) == 1
        with pytest.raises(KeyboardInterrupt):
            doubled()


@keeps_what_is_there
def looked_at(look):
    interrupts_are_noted()
    return outlasting_interrupts(look, "not looked at")


@pytest.mark.usefixtures("interrupts_arrive")
def test_without_ranks_an_interrupt_ends_it():
    assert looked_at(lambda: "a look") == "a look"
    assert looked_at(lambda: signal.raise_signal(signal.SIGINT)) == "not looked at"


# Processors of a computer on which several processes run.


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
