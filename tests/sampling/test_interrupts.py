"""Ctrl-C where it must not raise."""

import signal
from concurrent.futures import ThreadPoolExecutor

import pytest

from pymc_statespace_filters.parallel.signals import (
    deferred_interrupts,
    held_interrupts,
    ignored_interrupts,
)

pytestmark = pytest.mark.usefixtures("interrupts_arrive")


def test_an_interrupt_is_noticed():
    with deferred_interrupts() as interrupted:
        assert not interrupted.is_set()
        signal.raise_signal(signal.SIGINT)
        assert interrupted.is_set()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_an_interrupt_is_held_back():
    lines = iter([lambda: signal.raise_signal(signal.SIGINT), lambda: None])
    with pytest.raises(KeyboardInterrupt), held_interrupts():
        _ = [line() for line in lines]
    assert list(lines) == []  # all were run
    with deferred_interrupts() as interrupted, held_interrupts():
        signal.raise_signal(signal.SIGINT)
    assert interrupted.is_set()  # what surrounds it decides


def test_an_interrupt_is_left_to_another_rank():
    with ignored_interrupts():
        signal.raise_signal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("context", [deferred_interrupts, held_interrupts, ignored_interrupts])
def test_other_threads_are_never_interrupted(context):
    def inside():
        with context():
            return signal.getsignal(signal.SIGINT)

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(inside).result() is signal.default_int_handler
